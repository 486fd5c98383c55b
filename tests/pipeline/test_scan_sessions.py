"""Loops between scans by hand and between two drives, from logs on disk to run folders."""

import shutil

import numpy as np
import pytest

from mapper.config.loading import load_config, overridden
from mapper.core.errors import ConfigError, LoopError
from mapper.evaluators.metrics.trajectory_errors import ate_rmse_m
from mapper.loops.closure import discrepancy
from mapper.pipeline.append import append
from mapper.pipeline.build import build
from mapper.pipeline.edit import edit_loops
from mapper.run.folder import open_run
from mapper.simulation.config import STREET, LidarSensorConfig, LidarSynthConfig, SynthImuConfig
from mapper.simulation.lidar import write_lidar_log
from mapper.sources import open_source

SETTINGS = ("octree.resolution_m=0.5", "octree.max_range_m=30", "loops.kind=none")
DRIVE = STREET.model_copy(
    update={
        "seed": 5,
        "loop_m": 150.0,
        "duration_s": 6.0,
        "rate_hz": 5.0,
        "sensor": LidarSensorConfig(rings=24, azimuth_steps=360),
    }
)
AGAIN = DRIVE.model_copy(update={"duration_s": 5.0, "speed_mps": 4.0, "yaw_swing_rad": 0.5})
ELSEWHERE = DRIVE.model_copy(update={"seed": 6})


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drives")
    for name, config in (("drive", DRIVE), ("again", AGAIN), ("elsewhere", ELSEWHERE)):
        write_lidar_log(folder / name, config)
    return folder


@pytest.fixture(scope="module")
def first(logs):
    """A drive along new streets, on which no loops were looked for."""
    config = load_config(None, SETTINGS, sensor="lidar")
    return build(open_source(logs / "drive", config.source), config, logs / "run")


def appended(run, log, out):
    config = overridden(run.config, ["loops.kind=scans"])
    return append(open_source(log, config.source), run, config, out)


def error_m(run):
    return ate_rmse_m(run.trajectory, run.truth)


def test_a_loop_between_scans_can_be_added_by_hand(first, tmp_path):
    shutil.copytree(first.path, tmp_path / "run")
    copy = open_run(tmp_path / "run")
    edited = edit_loops(copy.open_log(), copy, add=[(2, 9)])
    (loop,) = edited.loops
    truth = edited.truth
    T_world_body = dict(zip(truth.stamps_ns.tolist(), truth.T_world_body, strict=True))
    miss = discrepancy(loop.T_i_j, T_world_body[loop.stamp_i_ns], T_world_body[loop.stamp_j_ns])
    assert (loop.proposed_by, loop.verdict) == ("hand", "accepted")
    assert miss.translation_m < 0.1
    assert miss.rotation_rad < 0.01
    assert 0 < loop.inliers <= loop.matches


def test_scans_of_two_places_are_no_loop_whoever_says_so(first, tmp_path):
    shutil.copytree(first.path, tmp_path / "run")
    copy = open_run(tmp_path / "run")
    with pytest.raises(LoopError, match=r"loop 0 → 20: not added; (vote|overlap|free space): "):
        edit_loops(copy.open_log(), copy, add=[(0, 20)])
    assert open_run(copy.path).loops == []


def test_a_second_drive_is_tied_to_the_first(first, logs, tmp_path):
    joined = appended(first, logs / "again", tmp_path / "joined")
    nodes = len(first.graph.T_world_node)
    between = [loop for loop in joined.loops if loop.verdict == "accepted" and loop.i < nodes <= loop.j]
    assert len(between) >= 5
    assert {loop.proposed_by for loop in between} == {"scans"}
    assert error_m(joined) < 0.1
    np.testing.assert_allclose(joined.graph.T_world_node[0], first.graph.T_world_node[0], atol=0.01)


def test_a_drive_elsewhere_is_refused(first, logs, tmp_path):
    with pytest.raises(LoopError, match="no loop connects it"):
        appended(first, logs / "elsewhere", tmp_path / "joined")
    assert not (tmp_path / "joined").exists()


def test_loops_between_images_are_refused_for_scans(logs, tmp_path):
    config = load_config(None, ["loops.kind=places"], sensor="lidar")
    with pytest.raises(ConfigError, match="compare images, and these are scans; want scans"):
        build(open_source(logs / "drive", config.source), config, tmp_path / "run")


def test_both_sessions_keep_their_gyroscopes(tmp_path):
    hand = LidarSynthConfig(
        scene="courtyard", seed=2, loop_m=60.0, rate_hz=2.0, duration_s=12.0, speed_mps=1.2, tilt_rad=0.3,
        yaw_swing_rad=1.5, imu=SynthImuConfig(),
        sensor=LidarSensorConfig(rings=16, lowest_ring_rad=-0.26, highest_ring_rad=0.26, azimuth_steps=450),
    )  # fmt: skip
    write_lidar_log(tmp_path / "one", hand)
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    config = load_config(None, SETTINGS, sensor="lidar")
    one = build(open_source(tmp_path / "one", config.source), config, tmp_path / "run")
    both = appended(one, tmp_path / "two", tmp_path / "both")
    (later,) = both.manifest.input.appended
    for fit in (both.manifest.gyroscope, later.gyroscope):
        assert fit.offset_s == pytest.approx(0.007, abs=0.004)
    log = both.open_log()
    assert log.gyroscope.is_of_body
    assert log.gyroscope.stamps_ns[0] < log.stamps_ns[0] + 10_000_000
    assert log.gyroscope.stamps_ns[-1] >= log.stamps_ns[-1]
    assert np.abs(log.gyroscope.rates_radps).max() < 4.0
