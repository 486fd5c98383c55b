"""Places that runs share, found in scans of synthetic streets."""

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse
from mapper.loops.config import ScanLoopsConfig
from mapper.loops.factory import build_verifier
from mapper.loops.inter_session_loops import find_shared_places
from mapper.loops.map_constraints import KnownPlaces
from tests.support.counted_jobs import run_elsewhere
from tests.support.street_scans import on_street, street, view

CONFIG = ScanLoopsConfig()


def drive(seed, begin_m, end_m, T_world_street=None, *, back=False):
    """Return the places of a drive, in a world of its own."""
    scene, verifier = street(seed), build_verifier(CONFIG.verification)
    along_m = np.arange(begin_m, end_m, 4.0)[:: -1 if back else 1]
    poses = [on_street(scene, along, yaw_rad=np.pi if back else 0.0) for along in along_m]
    T_world_street = np.eye(4) if T_world_street is None else T_world_street
    return KnownPlaces(
        {k: verifier.describe(view(scene, T, stamp_ns=k, seed=k + 100 * back)) for k, T in enumerate(poses)},
        {k: T_world_street @ T for k, T in enumerate(poses)},
    )


@pytest.fixture(scope="module")
def first():
    return drive(1, 0, 40)


def test_the_way_back_has_the_same_places(first):
    T_world_street = exp(np.array([0.0, 0.0, 1.0]), np.array([500.0, -300.0, 20.0]))
    found = find_shared_places([first, drive(1, 14, 54, T_world_street, back=True)], CONFIG)
    assert len(found) >= 5
    for place in found:
        assert (place.first, place.second) == (0, 1)
        miss = inverse(place.T_first_body) @ inverse(T_world_street) @ place.T_second_body
        assert np.linalg.norm(miss[:3, 3]) < 0.3
        assert np.linalg.norm((inverse(place.T_first_place) @ place.T_first_body)[:3, 3]) < 30.0


def test_other_processes_measure_the_same(first, monkeypatch):
    runs = [first, drive(1, 14, 54), drive(1, 4, 30, back=True)]
    here = find_shared_places(runs, CONFIG)
    monkeypatch.setattr("mapper.loops.inter_session_loops.run_jobs", run_elsewhere)
    elsewhere = find_shared_places(runs, CONFIG)
    assert {(place.first, place.second) for place in here} == {(0, 1), (0, 2), (1, 2)}
    assert [(place.first, place.second, place.loop.i, place.loop.j) for place in here] == [
        (place.first, place.second, place.loop.i, place.loop.j) for place in elsewhere
    ]
    assert all(
        np.array_equal(a.T_first_body, b.T_first_body)
        and np.array_equal(a.loop.information, b.loop.information)
        for a, b in zip(here, elsewhere, strict=True)
    )


def test_other_streets_and_runs_without_places_share_none(first):
    assert find_shared_places([first, drive(2, 0, 40), KnownPlaces({}, {})], CONFIG) == []
    assert find_shared_places([KnownPlaces({}, {})], CONFIG) == []
