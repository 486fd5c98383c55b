"""Scan Context: the same for every heading, another at another place."""

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.core.geometry import apply, rotation_exp, transform
from mapper.places.config import ScanContextConfig
from mapper.places.scan_context import ScanContexts, scan_context
from tests.support.street_scans import MOUNT_M, on_street, street, view

CONFIG = ScanContextConfig()
TO_GROUND = transform(np.eye(3), np.array([0.0, 0.0, MOUNT_M]))


def context(scene, along_m, *, config=CONFIG, seed=0, **turned):
    seen = view(scene, on_street(scene, along_m, **turned), seed=seed)
    return scan_context(apply(TO_GROUND, seen.points_body.astype(np.float64)), config)


def similarity(a, b):
    index = ScanContexts(ScanContextConfig(min_similarity=0.0))
    index.add(0, a)
    ((_, value),) = index.query(b, np.array([True]), limit=1)
    return value


@pytest.mark.parametrize("yaw_deg", [6.0, 90.0, 180.0, -78.0])
def test_turning_the_scanner_by_whole_sectors_changes_nothing(yaw_deg):
    rng = np.random.default_rng(0)
    points_level = rng.uniform([-40.0, -40.0, 0.0], [40.0, 40.0, 10.0], (5000, 3))
    R = rotation_exp(np.array([0.0, 0.0, np.radians(yaw_deg)]))
    before, after = (scan_context(points, CONFIG) for points in (points_level, points_level @ R.T))
    np.testing.assert_allclose(after.ring_key, before.ring_key, atol=1e-3)
    assert similarity(before, after) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("yaw_rad", [0.05, 1.0, np.pi, -2.0])
def test_the_same_place_is_similar_from_the_other_lane_and_any_heading(yaw_rad):
    scene = street(1)
    here = context(scene, 40.0)
    again = similarity(here, context(scene, 41.0, yaw_rad=yaw_rad, left_m=1.0, seed=1))
    elsewhere = [similarity(here, context(street(2), along_m)) for along_m in (0.0, 50.0, 100.0)]
    assert again > CONFIG.min_similarity
    assert again > max(elsewhere) + 0.05


def test_the_index_finds_the_nearest_place():
    scene = street(1)
    index = ScanContexts(CONFIG)
    for node, along_m in enumerate(range(0, 150, 5)):
        index.add(10 + node, context(scene, along_m))
    found = index.query(context(scene, 61.0, yaw_rad=2.5, seed=1), np.ones(30, np.bool_), limit=3)
    assert found[0][0] == 10 + 12
    assert [value for _, value in found] == sorted((value for _, value in found), reverse=True)


def test_only_those_asked_for_take_part():
    scene = street(1)
    index = ScanContexts(CONFIG)
    for node in range(3):
        index.add(node, context(scene, 2.0 * node))
    seen = context(scene, 2.0, seed=1)
    assert {node for node, _ in index.query(seen, np.array([True, False, True]), limit=5)} == {0, 2}
    assert index.query(seen, np.array([False]), limit=5) == []
    assert len(index.query(seen, np.ones(3, np.bool_), limit=1)) == 1


def test_the_shortlist_is_of_the_nearest_ring_keys(monkeypatch):
    rng = np.random.default_rng(0)
    flat, high = (rng.uniform([-40, -40, 0], [40, 40, top], (5000, 3)) for top in (1.0, 10.0))
    monkeypatch.setattr("mapper.places.scan_context.SHORTLIST", 1)
    index = ScanContexts(ScanContextConfig(min_similarity=0.0))
    index.add(0, scan_context(high, CONFIG))
    index.add(1, scan_context(flat, CONFIG))
    ((node, _),) = index.query(scan_context(flat * 1.01, CONFIG), np.ones(2, np.bool_), limit=5)
    assert node == 1


def test_many_places_are_kept():
    index = ScanContexts(CONFIG)
    rng = np.random.default_rng(0)
    contexts = [scan_context(rng.uniform(-40, 40, (200, 3)), CONFIG) for _ in range(300)]
    for node, one in enumerate(contexts):
        index.add(node, one)
    assert len(index) == 300
    assert index.query(contexts[270], np.ones(300, np.bool_), limit=1)[0][0] == 270


def test_an_empty_scan_is_similar_to_none():
    empty = scan_context(np.empty((0, 3)), CONFIG)
    assert not empty.ring_key.any()
    assert similarity(empty, context(street(1), 0.0)) == 0.0


def test_a_context_of_other_rings_is_refused():
    other = scan_context(np.empty((0, 3)), ScanContextConfig(rings=10))
    with pytest.raises(DataError, match=r"scan context of node 7: \(10, 31\), want \(20, 31\)"):
        ScanContexts(CONFIG).add(7, other)
