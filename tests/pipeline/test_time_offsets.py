"""Time offsets of a log's sensors: found by motion and by outlines in depth, and corrected by settings."""

import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import ConfigError
from mapper.core.frames import PinholeCamera, Scan
from mapper.core.geometry import exp, log, rotation_exp
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.pipeline.time_offsets import measure_time_offsets
from mapper.sensing.gyroscope import Gyroscope
from mapper.sources import open_source
from mapper.sources.base import CameraImages, SensorBeside
from mapper.sources.config import SourceConfig
from mapper.sources.depth_time import depth_time_offset
from mapper.sources.frame_selection import selected
from mapper.sources.time_offsets import time_offset
from mapper.sources.trajectory_files import write_tum
from tests.support.command_line import mapper
from tests.support.logs import log_in_memory, memory_entry
from tests.support.paths import DATA

FR1_XYZ = DATA / "tum_fr1_xyz"
real = pytest.mark.skipif(not FR1_XYZ.exists(), reason=f"{FR1_XYZ} is not there")


def path_at(seconds, *, turns=True):
    """Poses of a walk whose speed changes all the time, at (N,) seconds."""
    x = 0.8 * seconds + 0.5 * np.sin(1.1 * seconds) + 0.2 * np.sin(2.9 * seconds)
    yaw = 0.9 * np.sin(0.7 * seconds) + 0.3 * np.sin(2.3 * seconds) if turns else 0.0 * seconds
    poses = [exp(np.array([0.0, 0.0, a]), np.array([b, 0.3 * a, 0.0])) for a, b in zip(yaw, x, strict=True)]
    return Trajectory(np.round((seconds + 5.0) * NS_PER_S).astype(np.int64), np.array(poses))


def late(path, offset_s):
    return Trajectory(path.stamps_ns + round(offset_s * NS_PER_S), path.T_world_body)


def gyroscope_of(path, *, mounting_rad=(0.4, -1.0, 0.3)):
    """Angular velocities of a path in a unit that is mounted askew, in degrees per second."""
    R = rotation_exp(np.array(mounting_rad))
    inverses = np.linalg.inv(path.T_world_body[:-1])
    turns = np.array([log(step)[0] for step in inverses @ path.T_world_body[1:]])
    rates = np.degrees(turns / (np.diff(path.stamps_ns) / NS_PER_S)[:, None]) @ R
    return Gyroscope("imu", (path.stamps_ns[:-1] + path.stamps_ns[1:]) // 2, rates)


def walk(tmp_path, *, turns=True, seconds=30.0, **facts):
    """A log whose odometry is known: 10 scans per second."""
    frames = path_at(np.arange(0.0, seconds, 0.1), turns=turns)
    point = np.ones((1, 3), np.float32)
    entries = [memory_entry(stamp_ns, Scan(stamp_ns, point)) for stamp_ns in frames.stamps_ns.tolist()]
    write_tum(tmp_path / "known.tum", frames)
    settings = ["odometry.kind=given", f"odometry.path={tmp_path / 'known.tum'}", "loops.kind=none"]
    return log_in_memory(entries, sensor="lidar", **facts), load_config(None, settings, sensor="lidar")


@pytest.mark.parametrize("offset_s", [0.0, 0.123, -0.4])
@pytest.mark.parametrize("turns", [True, False])
def test_late_poses_are_found_by_turns_or_by_ways_travelled(tmp_path, offset_s, turns):
    known = late(path_at(np.arange(-2.0, 32.0, 0.02), turns=turns), offset_s)
    source, config = walk(tmp_path, turns=turns, truth=known, wheels=late(known, 0.05))
    truth, wheels = sorted(measure_time_offsets(source, config), key=lambda one: one.sensor)
    assert (truth.sensor, wheels.sensor) == ("truth", "wheels")
    assert truth.late_s == pytest.approx(offset_s, abs=0.003)
    assert wheels.late_s == pytest.approx(offset_s + 0.05, abs=0.003)
    assert bool(truth.remedy) == (offset_s != 0.0)


@pytest.mark.parametrize("offset_s", [0.007, -0.25, 0.7])
def test_a_late_gyroscope_is_found_whatever_its_mounting_and_unit(tmp_path, offset_s):
    readings = gyroscope_of(late(path_at(np.arange(-2.0, 32.0, 0.005)), offset_s))
    (found,) = measure_time_offsets(*walk(tmp_path, gyroscope=readings))
    assert found.late_s == pytest.approx(offset_s, abs=0.003)


@pytest.mark.parametrize("offset_s", [0.08, -0.3])
def test_late_images_beside_a_lidar_are_found_by_their_turns(tmp_path, offset_s):
    """The camera, with x right, y down and z forward, sees what is far away."""
    world = cv2.blur(np.random.default_rng(1).integers(0, 255, (500, 6000), np.uint8), (5, 5))
    seen, camera = path_at(np.arange(0.0, 12.0, 0.07)), PinholeCamera(320, 240, 250.0, 250.0, 159.5, 119.5)
    rows, columns = np.mgrid[:240, :320].astype(np.float32)
    rays = np.stack([(columns - 159.5) / 250.0, (rows - 119.5) / 250.0, np.ones_like(rows)], axis=-1)
    R_body_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

    def image_at(index):
        x, y, z = np.moveaxis(rays @ (seen.T_world_body[index, :3, :3] @ R_body_camera).T, -1, 0)
        at = 3000.0 - 900.0 * np.arctan2(y, x), 250.0 - 900.0 * z / np.hypot(x, y) * 0.8
        return cv2.remap(world, *(one.astype(np.float32) for one in at), cv2.INTER_LINEAR)

    T_body_camera = np.eye(4)
    T_body_camera[:3, :3] = R_body_camera
    images = CameraImages("/image", late(seen, offset_s).stamps_ns, camera, T_body_camera, image_at)
    log_, config = walk(tmp_path, seconds=12.0, images=[images])
    other = SensorBeside(replace(log_, name="/rear", images=[]), np.eye(4))
    found, rear = measure_time_offsets(replace(log_, beside=[other]), config)
    assert (found.sensor, found.late_s) == ("/image", pytest.approx(offset_s, abs=0.01))
    assert (rear.sensor, rear.late_s, rear.is_measured) == ("/rear", None, False)
    setting = float(re.search(r"--set source.images_offset_s=(\S+)", found.remedy)[1])
    moved = selected(log_, SourceConfig(images_offset_s=setting))
    assert moved.images[0].stamps_ns[0] == pytest.approx(seen.stamps_ns[0], abs=1e7)


@pytest.mark.parametrize("facts", ["another walk", "too short", "at rest"])
def test_an_offset_that_cannot_be_told_is_not_guessed(tmp_path, facts):
    moments = np.arange(-2.0, 32.0, 0.02)
    known = path_at(moments)
    if facts == "another walk":
        known = Trajectory(known.stamps_ns, known.T_world_body[np.random.default_rng(3).permutation(1700)])
    elif facts == "at rest":
        known = Trajectory(known.stamps_ns, np.tile(np.eye(4), (len(known), 1, 1)))
    (found,) = measure_time_offsets(
        *walk(tmp_path, truth=known, seconds=1.5 if facts == "too short" else 30.0)
    )
    assert (found.late_s, found.sigma_s, found.remedy) == (None, None, "")


def test_settings_move_the_stamps_before_frames_are_selected(tmp_path):
    known = late(path_at(np.arange(0.0, 30.0, 0.1)), 60.0)
    source, _ = walk(tmp_path, truth=known, wheels=known, gyroscope=gyroscope_of(known))
    config = SourceConfig(truth_offset_s=-60.0, wheels_offset_s=0.25, imu_offset_s=-0.5, require_truth=True)
    moved = selected(source, config)
    assert len(moved) == len(source)
    assert np.array_equal(moved.truth.stamps_ns, source.stamps_ns)
    assert np.array_equal(moved.wheels.stamps_ns, known.stamps_ns + 250_000_000)
    assert np.array_equal(moved.gyroscope.stamps_ns, source.gyroscope.stamps_ns - 500_000_000)


def test_a_setting_that_is_the_whole_offset_is_proposed_to_be_zero():
    found = time_offset("truth", [-0.3001, -0.3, -0.2999], setting="source.truth_offset_s", set_s=-0.3)
    assert found.remedy.split()[1] == "source.truth_offset_s=0"


def test_poses_that_are_the_odometry_have_no_offset(tmp_path):
    truth, wheels, device_poses = (path_at(np.arange(-2.0, 32.0, 0.1)) for _ in range(3))
    source, _ = walk(tmp_path, truth=truth, wheels=wheels, device_poses=device_poses)
    for settings, compared in (
        (["odometry.kind=wheels"], ["truth", "device poses"]),
        (["odometry.kind=given"], ["wheels", "device poses"]),
    ):
        config = load_config(None, [*settings, "loops.kind=none"], sensor="lidar")
        assert [one.sensor for one in measure_time_offsets(source, config)] == compared


def test_a_log_of_scans_alone_says_that_nothing_is_compared(tmp_path):
    for index in range(12):
        points = np.random.default_rng(index).uniform(0.0, 9.0, (500, 4)).astype("<f4")
        (tmp_path / f"{index:06d}.bin").write_bytes(points.tobytes())
    shown = mapper("inspect", tmp_path, "--time-offset").output
    assert sum(line.startswith("time ") for line in shown.splitlines()) == 1
    answer = json.loads(mapper("inspect", tmp_path, "--time-offset", "--json").stdout)
    assert answer["time_offsets"] == []
    assert json.loads(mapper("inspect", tmp_path, "--json").stdout)["time_offsets"] is None


@pytest.mark.parametrize("sensor", ["depth", "imu", "wheels", "truth"])
def test_an_offset_that_no_stamp_can_hold_is_refused(sensor):
    for offset_s in (5e9, -1e300, float("inf")):
        with pytest.raises(ConfigError, match=f"{sensor}_offset_s"):
            load_config(None, [f"source.{sensor}_offset_s={offset_s}"], sensor="rgbd")


@real
def test_late_depth_is_found_in_real_images_and_the_proposed_setting_leaves_none():
    def depth(offset_s):
        config = SourceConfig(depth_offset_s=offset_s, last_frame=100)
        return depth_time_offset(open_source(FR1_XYZ, config), config)

    as_recorded, later = depth(0.0), depth(0.1)
    assert later.late_s - as_recorded.late_s == pytest.approx(0.1, abs=0.006)
    proposed = re.search(r"--set source.depth_offset_s=(\S+)", later.remedy)
    corrected = depth(float(proposed[1]))
    assert (corrected.remedy, corrected.late_s) == ("", pytest.approx(0.0, abs=0.006))
