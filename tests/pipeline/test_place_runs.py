"""Runs of one place that find each other without truth or a common world."""

import json

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import RunError
from mapper.core.geometry import angle_between, inverse
from mapper.loops.map_constraints import KnownPlaces
from mapper.loops.scan_context_proposer import ScanPlace
from mapper.merging.placing import by_truth
from mapper.pipeline import place_runs
from mapper.pipeline.build import build
from mapper.pipeline.known_map import run_places
from mapper.pipeline.place_runs import place_by_shared_places
from mapper.sources import open_source
from tests.support.command_line import mapper
from tests.support.desk import MANY_KEYFRAMES, write_log_of_another_flat


def built(log, out, *overrides):
    config = load_config(None, [*MANY_KEYFRAMES, *overrides])
    return build(open_source(log, config.source), config, out)


@pytest.fixture(scope="module")
def halves(desk_log, tmp_path_factory):
    """The runs of the walk's halves, each in a world of its own."""
    folder = tmp_path_factory.mktemp("runs")
    return [
        built(desk_log, folder / "early", "source.last_frame=15"),
        built(desk_log, folder / "late", "source.first_frame=14"),
    ]


@pytest.fixture(scope="module")
def elsewhere(halves, tmp_path_factory):
    log = tmp_path_factory.mktemp("synthetic") / "log"
    write_log_of_another_flat(log)
    return built(log, halves[0].path.with_name("elsewhere"))


@pytest.mark.parametrize("first", [0, 1])
def test_halves_of_a_walk_lie_as_their_truths_do(halves, first):
    runs = [halves[first], halves[1 - first]]
    placing = place_by_shared_places(runs)
    assert not placing.left_out
    assert placing.placed[0].stays
    T_found, T_true = placing.placed[1].T_map_world, by_truth(runs)[1].T_map_world
    assert np.linalg.norm((inverse(T_true) @ T_found)[:3, 3]) < 0.02
    assert angle_between(T_true[:3, :3], T_found[:3, :3]) < 0.02


def test_a_merge_names_the_run_that_it_leaves_out(halves, elsewhere, tmp_path):
    result = mapper(
        "merge", halves[0].path, elsewhere.path, halves[1].path, "--out", tmp_path / "map", "--place", "auto"
    )
    assert f"mapper: {elsewhere.path}: left out, " in result.stderr
    manifest = json.loads((tmp_path / "map" / "manifest.json").read_text())
    assert [run["path"] for run in manifest["runs"]] == [str(half.path) for half in halves]
    assert manifest["runs"][1]["placed"].startswith("by ")
    assert manifest["notes"][0].startswith(f"{elsewhere.path}: left out, ")


def test_runs_of_different_places_are_no_map(halves, elsewhere, tmp_path):
    out = tmp_path / "out"
    for verb in ("merge", "diff"):
        result = mapper(
            verb, halves[0].path, elsewhere.path, "--out", out, "--place", "auto", "--quiet", status=1
        )
        assert f"mapper: {halves[0].path}: no other run is tied to it" in result.stderr
        assert result.stderr.count("\n") == 1
        assert not out.exists()


def test_two_runs_are_compared_without_a_common_world(halves, tmp_path):
    mapper("diff", halves[0].path, halves[1].path, "--out", tmp_path / "diff", "--place", "auto", "--quiet")
    found = json.loads((tmp_path / "diff" / "manifest.json").read_text())
    T_true = by_truth(halves)[1].T_map_world
    miss = inverse(T_true) @ np.array(found["T_before_after"])
    assert np.linalg.norm(miss[:3, 3]) < 0.06  # refined by voxels of 0.05 m
    assert found["voxels"]["same"] > 100


def test_a_run_whose_places_do_not_compare_is_left_out(halves, monkeypatch):
    street = ScanPlace(0, np.zeros((1, 3), np.float32), np.eye(4))
    known = {halves[0].path: [KnownPlaces({}, {}), KnownPlaces({0: street}, {0: np.eye(4)})]}

    def places_of(run, *, progress):
        return known[run.path].pop() if run.path in known else run_places(run, progress=progress)

    monkeypatch.setattr(place_runs, "run_places", places_of)
    with pytest.raises(RunError, match="is of sensor lidar, and the first run of rgbd"):
        place_by_shared_places([halves[1], halves[0]])
    with pytest.raises(RunError, match="no keyframe of it can be recognised"):
        place_by_shared_places([halves[0], halves[1]])
