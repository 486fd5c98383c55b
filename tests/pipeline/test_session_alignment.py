"""Runs of one place that find each other without truth or a common world."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import RunError
from mapper.core.geometry import angle_between, apply, exp, fit_rigid, inverse
from mapper.core.timebase import nearest
from mapper.core.trajectory import Trajectory
from mapper.loops import inter_session_loops
from mapper.loops.base import verify_proposal
from mapper.loops.closure import read_closures
from mapper.loops.map_constraints import KnownPlaces
from mapper.loops.scan_context_proposer import ScanPlace
from mapper.merging.merge import merge
from mapper.merging.merged_map import open_map
from mapper.merging.world_poses import Placed, Placing, by_truth
from mapper.octree.map import read_octree
from mapper.pipeline import session_alignment
from mapper.pipeline.build import build
from mapper.pipeline.fuse import fuse
from mapper.pipeline.known_map import run_places
from mapper.pipeline.session_alignment import place_by_shared_places, place_jointly
from mapper.run.folder import moved_log, open_run
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


def files_of(run):
    return {path.name: path.read_bytes() for path in run.path.iterdir() if path.is_file()}


def test_halves_are_joined_by_one_graph(halves, elsewhere, tmp_path):
    before = [files_of(half) for half in halves]
    placing = place_jointly([halves[1], elsewhere, halves[0]])
    assert list(placing.left_out) == [str(elsewhere.path)]
    found = merge(placing, tmp_path / "map").map

    truth = halves[0].truth
    for run, placed in zip(found.manifest.runs, placing.placed, strict=True):
        poses = found.trajectory(run)
        np.testing.assert_allclose(poses.T_world_body, placed.trajectory_map.T_world_body, atol=1e-6)
        assert run.fused_again == (placed.moved_m > 0.5 * found.manifest.octree.resolution_m)
        assert (found.path / run.folder / "map.octree").exists() == run.fused_again
    apart = [len(run.graph.T_world_node) for run in (halves[1], halves[0])]
    assert len(found.graph.T_world_node) == sum(apart)
    joined = [found.trajectory(run) for run in found.manifest.runs]
    positions = np.concatenate([poses.positions_world for poses in joined])
    true = np.concatenate(
        [truth.positions_world[nearest(truth.stamps_ns, poses.stamps_ns)[0]] for poses in joined]
    )
    T_true_map, _ = fit_rigid(true, positions)
    assert np.sqrt(((apply(T_true_map, positions) - true) ** 2).sum(axis=1).mean()) < 0.01
    (tie,) = found.manifest.ties
    assert tie.held >= 3
    held = [loop for loop in read_closures(found.path / "loops.jsonl") if loop.verdict == "accepted"]
    assert len(held) == tie.held
    assert all(loop.i < apart[0] <= loop.j for loop in held)
    assert [files_of(half) for half in halves] == before


def test_a_run_that_bends_is_fused_along_its_new_poses(halves, tmp_path):
    first, second = place_jointly(halves).placed
    bend = exp(np.array([0.0, 0.0, 0.02]), np.array([0.0, 0.0, 0.2]))
    poses = second.run.trajectory.T_world_body.copy()
    poses[len(poses) // 2 :] = bend @ poses[len(poses) // 2 :]
    bent = replace(second, bent=Trajectory(second.run.trajectory.stamps_ns, poses))
    assert bent.moved_m > 0.2
    again = fuse(second.run.open_log(), copied(second.run, tmp_path), second.run.config, trajectory=bent.bent)

    found = merge(Placing([first, bent]), tmp_path / "map").map

    described = found.manifest.runs[1]
    assert described.fused_again
    made = read_octree(found.path / described.folder / "map.octree")
    assert len(made) == pytest.approx(len(again.octree), rel=0.02)  # frames within half a voxel stay
    centres = again.octree.leaves().centres_world[again.octree.leaves().log_odds > 0.0]
    assert made.are_near_occupied(centres, max_distance_m=0.051).mean() > 0.99
    old = second.run.octree.are_near_occupied(centres, max_distance_m=0.051).mean()
    assert old < 0.97


def copied(run, folder):
    return open_run(shutil.copytree(run.path, folder / run.path.name))


def test_a_bent_run_without_its_log_is_placed_as_a_rigid_body(halves, tmp_path):
    run = copied(halves[1], tmp_path)
    moved = moved_log(run, tmp_path / "gone")
    bend = exp(np.zeros(3), np.array([0.0, 0.0, 0.2]))
    bent = Placed(moved, np.eye(4), "by hand", run.trajectory.moved(bend))
    found = merge(Placing([Placed(halves[0], np.eye(4), "first"), bent]), tmp_path / "map").map
    assert not found.manifest.runs[1].fused_again
    assert "is no longer there" in found.manifest.notes[0]
    assert "bends of up to 0.2 m stay" in found.manifest.notes[0]


def test_a_run_is_added_to_a_map_in_place(halves, elsewhere, desk_log, tmp_path, monkeypatch):
    middle = built(desk_log, tmp_path / "middle", "source.first_frame=3", "source.last_frame=27")
    out = tmp_path / "map"
    mapper("merge", *(half.path for half in halves), "--out", out, "--place", "auto", "--quiet")
    before = open_map(out).manifest
    compared = []

    def verify(proposal, node, *places):
        compared.append(places[1].stamp_ns)
        return verify_proposal(proposal, node, *places)

    monkeypatch.setattr(inter_session_loops, "verify_proposal", verify)
    result = mapper("merge", out, elsewhere.path, middle.path)
    assert f"mapper: {elsewhere.path}: left out, " in result.stderr

    found = open_map(out)
    assert [Path(run.path).name for run in found.manifest.runs] == ["early", "late", "middle"]
    new = [place.stamp_ns for run in (elsewhere, middle) for place in run_places(run).places.values()]
    assert compared
    assert set(compared) <= set(new)  # what the runs of the map share is known
    first, *others = found.manifest.ties
    assert (first.first, first.second, first.measured) == (0, 1, before.ties[0].measured)
    assert {(tie.first, tie.second) for tie in others} == {(0, 2), (1, 2)}
    apart = [len(run.graph.T_world_node) for run in (*halves, middle)]
    assert len(found.graph.T_world_node) == sum(apart)


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
    street = ScanPlace(0, np.eye(3, dtype=np.float32), np.eye(4))
    known = {halves[0].path: [KnownPlaces({}, {}), KnownPlaces({0: street}, {0: np.eye(4)})]}

    def places_of(run, *, progress):
        return known[run.path].pop() if run.path in known else run_places(run, progress=progress)

    monkeypatch.setattr(session_alignment, "run_places", places_of)
    with pytest.raises(RunError, match="is of sensor lidar, and the first run of rgbd"):
        place_by_shared_places([halves[1], halves[0]])
    with pytest.raises(RunError, match="no keyframe of it can be recognised"):
        place_by_shared_places([halves[0], halves[1]])
