"""Runs added to a merged map: the same map as of all runs, with little of it merged again."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import RunError
from mapper.core.frames import Scan
from mapper.core.geometry import exp
from mapper.merging import jobs as merging_jobs
from mapper.merging import merge as merging
from mapper.merging.merged_map import open_map
from mapper.merging.runs_in_map import runs_of
from mapper.merging.world_poses import Placed, as_built
from mapper.octree.map import OctreeMap
from tests.support.merged_runs import make_run, merged_map_of
from tests.support.octree_maps import CONFIG, mapped


@pytest.fixture(autouse=True)
def undrawn(monkeypatch):
    """Spare the picture, which takes half a second."""
    monkeypatch.setattr("mapper.merging.merge.draw", lambda *_: None)


@pytest.fixture
def runs(tmp_path):
    """Two runs, and a third that reaches a few of their tiles only, and some of its own."""
    small = OctreeMap(CONFIG)
    points = np.random.default_rng(9).uniform([0.5, 0.5, 0.5], [2.5, 2.5, 1.0], (40, 3)).astype(np.float32)
    pose = exp(np.zeros(3), np.array([0.6, 0.6, 0.6]))
    small.insert(Scan(1, points - pose[:3, 3].astype(np.float32)), pose)
    octrees = [mapped(0), mapped(1), small]
    return [make_run(tmp_path / f"run{i}", octree, log=f"{i}") for i, octree in enumerate(octrees)]


@pytest.fixture
def worked(monkeypatch):
    """The arguments of the jobs that split runs and that sum tiles."""
    calls = {"split": [], "join": []}

    def split(workspace, run, *rest):
        calls["split"].append((run, rest[-1]))
        return merging_jobs.split_run(workspace, run, *rest)

    def join(workspace, tile, *rest):
        calls["join"].append(tile)
        return merging_jobs.join_tile(workspace, tile, *rest)

    monkeypatch.setattr(merging, "split_run", split)
    monkeypatch.setattr(merging, "join_tile", join)
    return calls


def bytes_of(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_map_with_a_run_added_is_that_of_all_runs(runs, tmp_path, worked):
    whole = merged_map_of(as_built(runs), tmp_path / "whole", tile_m=2.4).map
    known = merged_map_of(as_built(runs[:2]), tmp_path / "map", tile_m=2.4).map
    of_new = {tile.name for tile in whole.manifest.tiles if 2 in tile.runs}
    assert 0 < len(of_new) < len(whole.manifest.tiles) / 2
    for calls in worked.values():
        calls.clear()

    found = merged_map_of(as_built(runs), known.path, tile_m=2.4, known=known, overwrite=True).map

    assert bytes_of(found.path) == bytes_of(whole.path)
    assert len(worked["join"]) == len(of_new)  # the other tiles are taken over
    assert worked["split"][0] == (2, None)
    assert all(only is not None and len(only) == len(of_new) for _, only in worked["split"][1:])


def test_a_run_that_has_moved_is_merged_again_and_one_that_has_not_stays(runs, tmp_path, worked):
    known = merged_map_of(as_built(runs[:2]), tmp_path / "map", tile_m=2.4).map
    resolution_m = known.manifest.octree.resolution_m
    near, far = (exp(np.zeros(3), np.array([by * resolution_m, 0.0, 0.0])) for by in (0.3, 3.0))
    first, second, third = as_built(runs)
    worked["join"].clear()

    kept = merged_map_of(
        [first, replace(second, T_map_world=near), third], tmp_path / "kept", tile_m=2.4, known=known
    ).map
    assert np.array_equal(kept.manifest.runs[1].T_map_world, np.eye(4))
    some = len(worked["join"])
    assert some < len(kept.manifest.tiles)
    worked["join"].clear()

    moved = [first, replace(second, T_map_world=far), third]
    again = merged_map_of(moved, tmp_path / "again", tile_m=2.4, known=known).map
    assert len(worked["join"]) > some
    whole = merged_map_of(moved, tmp_path / "whole", tile_m=2.4).map
    assert bytes_of(again.path) == bytes_of(whole.path)


def test_a_map_of_other_runs_or_tiles_is_made_anew(runs, tmp_path):
    known = merged_map_of(as_built(runs[:2]), tmp_path / "map", tile_m=2.4).map
    for number, (placed, tile_m) in enumerate([(as_built(runs[1:]), 2.4), (as_built(runs), 3.2)]):
        found = merged_map_of(placed, tmp_path / f"found{number}", tile_m=tile_m, known=known).map
        whole = merged_map_of(placed, tmp_path / f"whole{number}", tile_m=tile_m).map
        assert bytes_of(found.path) == bytes_of(whole.path)


def test_a_run_that_changed_since_is_refused(runs, tmp_path):
    known = merged_map_of(as_built(runs[:2]), tmp_path / "map").map
    assert [run.path for run in runs_of(known)] == [run.path for run in runs[:2]]
    make_run(runs[1].path, mapped(5))
    with pytest.raises(RunError, match=r"run1: changed since it was merged into .*map; merge again"):
        runs_of(open_map(known.path))


def test_a_run_comes_once(runs, tmp_path):
    known = merged_map_of(as_built(runs[:2]), tmp_path / "map").map
    twice = [*as_built(runs[:2]), Placed(runs[0], np.eye(4), "as built")]
    with pytest.raises(RunError, match="given twice"):
        merged_map_of(twice, tmp_path / "twice", known=known)
