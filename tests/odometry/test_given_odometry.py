"""Known poses as the odometry, of cameras and LiDARs, with loops and without."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import ConfigError, DataError, TrackingError
from mapper.core.geometry import angle_between, exp, interpolate, inverse
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.odometry.config import GivenOdometryConfig
from mapper.odometry.factory import build_odometry
from mapper.odometry.given_poses import poses_for
from mapper.pipeline.build import build
from mapper.pipeline.track import track_log
from mapper.pipeline.tracking_result import refuse_a_fragment
from mapper.run.folder import open_run
from mapper.run.manifest import RunWarning
from mapper.runtime.progress import SILENT
from mapper.simulation import CameraSimulator, make_scene
from mapper.simulation.lidar import LidarSimulator
from mapper.sources import open_source
from mapper.sources.trajectory_files import write_tum
from tests.support.command_line import mapper
from tests.support.logs import CountedReads
from tests.support.wheeled_worlds import FLAT, STREET_ON_WHEELS


@pytest.fixture(scope="module")
def flat():
    log = CameraSimulator(FLAT, make_scene(FLAT)).log()
    return replace(log, path=log.path.parent)


@pytest.fixture(scope="module")
def street():
    return LidarSimulator(STREET_ON_WHEELS).log()


def given(*overrides, sensor="rgbd"):
    return load_config(None, ["odometry.kind=given", *overrides], sensor=sensor)


def poses_at(truth, keep):
    """The poses of a truth whose time, seconds after the start, is kept, and in another world."""
    kept = keep((truth.stamps_ns - truth.stamps_ns[0]) / NS_PER_S)
    return Trajectory(
        truth.stamps_ns[kept], exp(np.array([0.1, 0.2, 0.3]), np.ones(3)) @ truth.T_world_body[kept]
    )


@pytest.mark.parametrize(
    ("log", "loops"), [("flat", "none"), ("flat", "places"), ("street", "none"), ("street", "scans")]
)
def test_every_frame_has_the_pose_of_the_truth(log, loops, request):
    source = request.getfixturevalue(log)
    watched = CountedReads(source)
    tracking = track_log(
        watched.log,
        given(f"loops.kind={loops}", "odometry.keyframe_distance_m=1", sensor=source.sensor),
        progress=SILENT,
    )
    nodes = set(tracking.graph.stamps_ns.values())
    keyframes = [k for k, stamp_ns in enumerate(source.stamps_ns) if stamp_ns in nodes]
    assert set(watched.reads) <= set(keyframes)
    assert bool(watched.reads) == (loops != "none")
    path = tracking.trajectory()
    np.testing.assert_array_equal(path.stamps_ns, source.stamps_ns)
    np.testing.assert_allclose(
        source.truth.T_world_body[0] @ path.T_world_body, source.truth.T_world_body, atol=1e-9
    )
    assert 1 < len(keyframes) < len(source)
    odometry = [factor for factor in tracking.graph.factors if factor.origin == "odometry"]
    assert len(odometry) == len(keyframes) - 1
    assert not any(factor.origin == "wheel" for factor in tracking.graph.factors)
    assert {track.diagnostics.method for track in tracking.tracks} == {"given"}


def test_factors_have_the_configured_noise(flat):
    def information(*overrides):
        tracking = track_log(flat, given("loops.kind=none", *overrides), progress=SILENT)
        return [factor.information for factor in tracking.graph.factors]

    for matrix in information("odometry.least_m=0.1", "odometry.least_rad=0.02"):
        np.testing.assert_allclose(np.diag(matrix), [0.02**-2] * 3 + [0.1**-2] * 3)
    drifting = information("odometry.least_m=0.1", "odometry.path_share=0.5")
    assert all(np.diag(matrix)[5] < 0.9 * 0.1**-2 for matrix in drifting)


def test_poses_of_a_file_are_interpolated_on_the_line_and_the_arc(flat, tmp_path):
    truth = flat.truth
    every_third = poses_at(truth, lambda s: np.arange(len(s)) % 3 == 0)
    write_tum(tmp_path / "poses.tum", every_third)
    config = given("loops.kind=none", f"odometry.path={tmp_path / 'poses.tum'}", "odometry.max_gap_s=0.51")
    path = track_log(flat, config, progress=SILENT).trajectory()
    assert len(path) == 3 * (len(every_third) - 1) + 1
    first, second = every_third.T_world_body[:2]
    T_world_given = inverse(first)
    for k in range(4):
        want = T_world_given @ interpolate(first, second, k / 3)
        np.testing.assert_allclose(path.T_world_body[k], want, atol=1e-6)
    turned = angle_between(first[:3, :3], second[:3, :3])
    assert angle_between(path.T_world_body[0][:3, :3], path.T_world_body[1][:3, :3]) == pytest.approx(
        turned / 3, abs=1e-6
    )


def test_frames_outside_the_poses_and_in_their_gaps_are_lost(flat, tmp_path):
    write_tum(tmp_path / "poses.tum", poses_at(flat.truth, lambda s: (s < 3.0) | ((s > 5.0) & (s < 7.0))))
    config = given("loops.kind=none", f"odometry.path={tmp_path / 'poses.tum'}")
    tracking = track_log(flat, config, progress=SILENT)
    lost = {
        round((track.stamp_ns - flat.stamps_ns[0]) / NS_PER_S * 6): track.diagnostics.method
        for track in tracking.tracks
        if track.node is None
    }
    assert lost == {
        **dict.fromkeys(range(18, 31), "lost in a gap of the given poses"),
        **dict.fromkeys(range(42, 49), "lost outside the given poses"),
    }
    placed = [track for track in tracking.tracks if track.node is not None]
    across = inverse(placed[0].T_world_body) @ placed[-1].T_world_body
    np.testing.assert_allclose(
        across, inverse(flat.truth.T_world_body[0]) @ flat.truth.T_world_body[41], atol=1e-6
    )


def test_a_path_starts_here_or_in_the_log_s_folder(flat, tmp_path, monkeypatch):
    log = replace(flat, path=tmp_path / "log")
    (tmp_path / "log").mkdir()
    config = GivenOdometryConfig(path="poses.tum")
    with pytest.raises(ConfigError, match=r"poses\.tum: no such file, nor in .*log \(odometry\.path\)"):
        poses_for(config, log)
    write_tum(tmp_path / "log/poses.tum", flat.truth)
    assert len(poses_for(config, log)) == len(flat)
    monkeypatch.chdir(tmp_path)
    write_tum(tmp_path / "poses.tum", poses_at(flat.truth, lambda s: s < 2.0))
    assert len(poses_for(config, log)) < len(flat)
    assert poses_for(GivenOdometryConfig(), log) is flat.truth


def test_mistakes_are_named_with_the_remedy(flat, tmp_path):
    with pytest.raises(ConfigError, match=r"neither true nor device poses; .*odometry\.path=poses\.tum"):
        track_log(replace(flat, truth=None), given(), progress=SILENT)
    with pytest.raises(ConfigError, match=r"loops\.kind=thesis looks .*odometry\.kind=given counts none"):
        track_log(flat, given("loops.kind=thesis"), progress=SILENT)
    path = tmp_path / "poses.tum"
    late = Trajectory(flat.truth.stamps_ns + 100 * NS_PER_S, flat.truth.T_world_body)
    write_tum(path, late)
    with pytest.raises(ConfigError, match=r"poses\.tum: poses from 17\d+\.\d+ to .* s, but the log's"):
        track_log(flat, given(f"odometry.path={path}"), progress=SILENT)
    path.write_text("1 2 3\n")
    with pytest.raises(DataError, match=r"poses\.tum:1: 3 columns, want 8"):
        track_log(flat, given(f"odometry.path={path}"), progress=SILENT)
    write_tum(path, poses_at(flat.truth, lambda s: s < 0.5))
    config = given("loops.kind=none", f"odometry.path={path}")
    tracking = track_log(flat, config, progress=SILENT)
    with pytest.raises(TrackingError, match="do the given poses cover the frames' times"):
        refuse_a_fragment(tracking, config, sensor="rgbd")
    known = [RunWarning(kind="depth", sentence="depth: 5 times too small", weight="doubt")]
    with pytest.raises(TrackingError, match="; depth: 5 times too small"):
        refuse_a_fragment(tracking, config, sensor="rgbd", known=known)


def test_a_scan_is_deskewed_by_the_poses_around_it_unless_these_are_sparse(street):
    truth = street.truth
    odometry = build_odometry(GivenOdometryConfig(), truth)
    entries = list(street.entries())
    tracks = [odometry.track(odometry.read(entry)) for entry in entries]
    assert tracks[5].twist.translation_mps == pytest.approx(
        (inverse(truth.T_world_body[4]) @ truth.T_world_body[6])[:3, 3] / 0.2, rel=0.05, abs=0.05
    )
    sparse = Trajectory(truth.stamps_ns[::50], truth.T_world_body[::50])
    odometry = build_odometry(GivenOdometryConfig(), sparse)
    assert odometry.track(odometry.read(entries[10])).twist is None


def test_a_desk_is_mapped_by_its_truth_on_the_command_line(desk_log, tmp_path):
    poses = desk_log / "groundtruth.txt"
    settings = ["--set", "odometry.kind=given", "--set", "loops.kind=none", "--set", f"odometry.path={poses}"]
    mapper("build", desk_log, "--out", tmp_path / "run", *settings, "--quiet")
    run = open_run(tmp_path / "run")
    assert run.manifest.counts.tracked == 31
    assert evaluate(run.trajectory, run.truth).ate_m < 1e-6
    assert run.config.odometry.path == poses


def test_loops_move_given_poses_by_their_noise_only(desk_log, tmp_path):
    log = open_source(desk_log)
    for loops in ("none", "places"):
        run = build(log, given(f"loops.kind={loops}"), tmp_path / loops)
        path = run.trajectory
        error = inverse(path.T_world_body[0]) @ path.T_world_body[-1]
        np.testing.assert_allclose(
            error,
            inverse(log.truth.T_world_body[0]) @ log.truth.T_world_body[-1],
            atol=1e-6 if loops == "none" else 0.02,
        )
