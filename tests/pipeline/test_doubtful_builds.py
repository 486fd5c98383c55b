"""Doubtful frames through a whole build: marked, placed, and in no map."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config, overridden
from mapper.core.errors import TrackingError
from mapper.core.geometry import exp
from mapper.evaluators.metrics.trajectory_errors import align, associate, ate
from mapper.export.mesh import mesh_views
from mapper.octree.map import read_octree
from mapper.octree.scan_updates import open_scan_updates
from mapper.pipeline.append import append
from mapper.pipeline.build import build
from mapper.pipeline.fuse import fuse
from mapper.run.folder import open_run
from mapper.runtime.progress import SILENT
from mapper.sources import open_source
from mapper.sources.time_offsets import TimeOffset
from tests.support.desk import REPEATABLE
from tests.support.doubting_odometry import DOUBTS, doubt_frames
from tests.support.files import files_of

WRONG = exp(np.array([0.0, 0.3, 0.0]), np.array([0.5, 0.0, 0.0]))
DOUBTED = dict.fromkeys((13, 14, 15), WRONG)


def built(log, out, *overrides):
    config = load_config(None, [REPEATABLE, *overrides])
    return build(open_source(log, config.source), config, out)


@pytest.fixture(scope="module")
def doubted(desk_log, tmp_path_factory):
    """A build of the desk log three of whose frames are 0.5 m off, and doubted; its depth seems late."""
    late = TimeOffset("depth", 0.05, 0.002, "--set source.depth_offset_s=-0.05 corrects that")
    with pytest.MonkeyPatch.context() as patch:
        doubt_frames(patch, DOUBTED)
        patch.setattr("mapper.pipeline.build.depth_time_offset", lambda *_: late)
        return built(desk_log, tmp_path_factory.mktemp("doubted") / "run")


def test_doubtful_frames_are_counted_and_named(doubted):
    counts = doubted.manifest.counts
    assert (counts.tracked, counts.doubtful, counts.lost) == (28, 3, 0)
    records = doubted.records
    assert [k for k, record in enumerate(records) if record.outcome == "doubtful"] == list(DOUBTED)
    assert records[14].doubts == DOUBTS
    assert counts.frames_text == "28 tracked, 3 doubtful, 0 lost, 0 skipped"


def test_late_depth_is_named_where_more_frames_are_doubtful_than_is_harmless(desk_log, doubted, tmp_path):
    def told(run):
        return [one.sentence for one in run.manifest.warnings if "depth_offset_s" in one.sentence]

    (sentence,) = told(doubted)
    assert "50 ± 2 ms late" in sentence
    with pytest.MonkeyPatch.context() as patch:
        doubt_frames(patch, {13: WRONG})
        patch.setattr("mapper.pipeline.build.depth_time_offset", None)  # fails if it is called
        assert told(built(desk_log, tmp_path / "run")) == []


def test_they_have_poses_between_their_neighbours(doubted, desk_run):
    ours, right = doubted.trajectory, desk_run.trajectory
    assert len(ours) == 31
    apart = np.linalg.norm(ours.positions_world - right.positions_world, axis=1)
    assert apart.max() < 0.05


def test_they_are_in_no_map(doubted):
    stamps_ns = doubted.trajectory.stamps_ns
    assert set(stamps_ns) - set(doubted.tracked_trajectory.stamps_ns) == set(stamps_ns[list(DOUBTED)])
    with open_scan_updates(doubted.path / "scan_updates.bin") as updates:
        fused = {
            k
            for k, (stamp_ns, T) in enumerate(
                zip(stamps_ns.tolist(), doubted.trajectory.T_world_body, strict=True)
            )
            if updates.holds(stamp_ns, T, config=doubted.config.octree)
        }
    assert fused == set(range(31)) - DOUBTED.keys()
    run = replace(doubted, config=overridden(doubted.config, ["mesh.frame_stride=1"]))
    assert len(list(mesh_views(run, read_octree(run.file("map.octree")), SILENT))) == 28


def test_fusing_again_leaves_them_out_again(doubted, tmp_path):
    again = open_run(shutil.copytree(doubted.path, tmp_path / "again"))
    (again.path / "scan_updates.bin").unlink()
    fused = fuse(again.open_log(), again, again.config)
    ours, theirs = files_of(fused.path), files_of(doubted.path)
    for name in ("map.ot", "cloud.ply", "frames.csv", "trajectory.tum", "run.mcap"):
        assert ours[name] == theirs[name], name


def test_a_pose_that_is_given_is_not_doubted(doubted, desk_run, tmp_path):
    again = open_run(shutil.copytree(doubted.path, tmp_path / "again"))
    fused = fuse(again.open_log(), again, again.config, trajectory=desk_run.trajectory)
    assert fused.manifest.counts.doubtful == 0
    assert (fused.path / "map.ot").read_bytes() == (desk_run.path / "map.ot").read_bytes()


def test_they_count_as_not_tracked(desk_log, tmp_path, monkeypatch):
    doubt_frames(monkeypatch, {index: np.eye(4) for index in range(25)})
    with pytest.raises(TrackingError, match=r"only \d+ of 31 .* more with doubts, want at least 29"):
        built(desk_log, tmp_path / "run", "min_tracked_ratio=0.91")


def test_an_appended_session_keeps_those_of_both(desk_log, tmp_path, monkeypatch):
    settings = [REPEATABLE, "odometry.max_keyframe_gap=3", "loops.min_motion_m=0.0"]
    doubt_frames(monkeypatch, {7: WRONG, 8: WRONG, 10: WRONG})
    config = load_config(None, [*settings, "source.last_frame=15"])
    first = build(open_source(desk_log, config.source), config, tmp_path / "first")
    before = {r.stamp_ns for r in first.records if r.outcome == "doubtful"}
    assert before
    second = load_config(None, [*settings, "source.first_frame=16"])
    joined = append(open_source(desk_log, second.source), first, second, tmp_path / "joined")
    doubtful = {r.stamp_ns for r in joined.records if r.outcome == "doubtful"}
    assert before < doubtful
    assert joined.manifest.counts.doubtful == len(doubtful)
    matched = associate(joined.trajectory, joined.truth)
    assert ate(align(matched, "se3").moved(matched)).max < 0.1
