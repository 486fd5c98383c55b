from dataclasses import replace

import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.core.geometry import exp, transform
from mapper.core.trajectory import Trajectory
from mapper.mapping.body_axes import AXES, BodyAxes
from mapper.mapping.config import LevelConfig
from mapper.sources.base import Accelerations
from tests.support.rooms import MS, ROOM, around, floor_height_m, level_of, log_of, pose, tilt_deg


def readings_of(trajectory, T_world_room, R_body_sensor, *, noise_mps2, seed=0, per_pose=32):
    """Readings around each pose, pointing up in the accelerometer's own axes."""
    rng = np.random.default_rng(seed)
    R_world_body = np.repeat(trajectory.T_world_body[:, :3, :3], per_pose, axis=0)
    up_sensor = np.einsum("ji,nkj,k->ni", R_body_sensor, R_world_body, T_world_room[:3, 2])
    stamps_ns = np.repeat(trajectory.stamps_ns, per_pose) + np.tile(np.arange(per_pose), len(trajectory)) * MS
    return Accelerations(stamps_ns, 9.81 * up_sensor + rng.normal(0, noise_mps2, up_sensor.shape))


SENSOR_AXES = [
    np.eye(3),
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]),
]


@pytest.mark.parametrize("R_body_sensor", SENSOR_AXES)
def test_an_accelerometer_of_any_axes_gives_up(R_body_sensor):
    poses = [
        pose(0, 0, 1.4, yaw_deg=y, down_deg=20 + 15 * np.sin(y / 15), roll_deg=10 * np.cos(y / 15))
        for y in range(0, 90, 3)
    ]
    scans, trajectory, T_world_room = log_of([], poses)
    accelerations = readings_of(trajectory, T_world_room, R_body_sensor, noise_mps2=0.6)
    level = level_of(scans, trajectory, accelerations)
    assert level.method == "accelerometer"
    assert tilt_deg(level, T_world_room) < 0.5


def test_an_accelerometer_with_ambiguous_axes_is_replaced_by_planes():
    still = [pose(0.02 * k, 0, 1.4, yaw_deg=0, down_deg=30) for k in range(8)]
    scans, trajectory, T_world_room = log_of(ROOM, still)
    accelerations = readings_of(trajectory, T_world_room, SENSOR_AXES[1], noise_mps2=0.5)
    level = level_of(scans, trajectory, accelerations)
    assert level.method == "planes"
    assert "ambiguous" in level.detail
    assert tilt_deg(level, T_world_room) < 0.5


@pytest.mark.parametrize(("shift_ns", "noise_mps2"), [(10**12, 0.1), (0, 30.0)])
def test_useless_readings_are_replaced_by_planes_with_the_reason(shift_ns, noise_mps2):
    scans, trajectory, T_world_room = log_of(ROOM, around())
    readings = readings_of(trajectory, T_world_room, np.eye(3), noise_mps2=noise_mps2)
    late = Accelerations(readings.stamps_ns + shift_ns, readings.acceleration_mps2)
    level = level_of(scans, trajectory, late)
    assert level.method == "planes"
    assert "accelerometer" in level.detail


def turned(T_room_cameras, quarters):
    """The poses of cameras turned about their optical axes."""
    return [T @ exp([0.0, 0.0, quarters * np.pi / 2.0], np.zeros(3)) for T in T_room_cameras]


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_an_accelerometer_that_the_path_confirms_says_how_a_camera_is_held(quarters):
    scans, trajectory, T_world_room = log_of(ROOM, turned(around(), quarters))
    readings = readings_of(trajectory, T_world_room, np.eye(3), noise_mps2=0.5, per_pose=16)
    readings = replace(readings, are_axes_stated=True, are_checked=True)
    level = level_of(scans, trajectory, readings)
    assert level.method == "accelerometer"
    assert tilt_deg(level, T_world_room) < 0.5
    assert floor_height_m(level, T_world_room) == pytest.approx(0.0, abs=0.03)
    assert bool(level.conflict) == (quarters > 0)
    assert level.is_decided


@pytest.mark.parametrize(("are_checked", "tilt"), [(True, 0.0), (False, 180.0)])
def test_only_a_confirmed_accelerometer_goes_before_the_mounting_of_a_camera(are_checked, tilt):
    scans, trajectory, T_world_room = log_of(ROOM, turned(around(), 2))
    readings = readings_of(trajectory, T_world_room, np.eye(3), noise_mps2=0.5, per_pose=16)
    readings = replace(readings, are_axes_stated=True, are_checked=are_checked)
    level = level_of(scans, trajectory, readings, axes=replace(AXES["rgbd"], are_stated=True))
    assert tilt_deg(level, T_world_room) == pytest.approx(tilt, abs=0.5)
    assert bool(level.conflict) == are_checked


def test_readings_of_an_unknown_sign_do_not_turn_a_camera_over():
    scans, trajectory, T_world_room = log_of(ROOM, around())
    felt = readings_of(trajectory, T_world_room, np.eye(3), noise_mps2=0.5, per_pose=16)
    reversed_ = replace(felt, acceleration_mps2=-felt.acceleration_mps2, are_axes_stated=True)
    level = level_of(scans, trajectory, reversed_)
    assert tilt_deg(level, T_world_room) < 0.5
    assert not level.conflict


@pytest.mark.parametrize(("quarters", "up"), [(0, "-y"), (1, "-x"), (2, "y"), (3, "x")])
def test_the_user_can_say_which_axis_of_a_camera_points_up(quarters, up):
    scans, trajectory, T_world_room = log_of(ROOM, turned(around(), quarters))
    assert tilt_deg(level_of(scans, trajectory, config=LevelConfig(up=up)), T_world_room) < 0.5


def street(*, is_inverted, has_ground=True, imu_is_inverted):
    """Scans of a LiDAR that drives 1.7 m above the ground beside a wall, and stated accelerations."""
    rng = np.random.default_rng(0)
    azimuth, range_m = rng.uniform(-np.pi, np.pi, 3000), np.exp(rng.uniform(np.log(2), np.log(20), 3000))
    ground = np.column_stack(
        [range_m * np.cos(azimuth), range_m * np.sin(azimuth), rng.normal(-1.7, 0.01, 3000)]
    )
    wall = np.column_stack([rng.uniform(-20, 20, 500), rng.normal(8.0, 0.01, 500), rng.uniform(-1.7, 4, 500)])
    points = np.concatenate([ground, wall]) if has_ground else wall
    R_body_robot = np.diag([1.0, -1.0, -1.0]) if is_inverted else np.eye(3)
    poses = [transform(np.eye(3), [0.1 * k, 0.0, 0.0]) for k in range(100)]
    trajectory = Trajectory(np.arange(100, dtype=np.int64) * 100 * MS, np.array(poses))
    scans = [(Scan(0, (points @ R_body_robot.T).astype(np.float32)), T) for T in poses[:5]]
    felt = [0.0, 0.0, -9.81 if imu_is_inverted else 9.81]
    return (
        scans,
        trajectory,
        Accelerations(trajectory.stamps_ns, np.tile(felt, (100, 1)), are_axes_stated=True),
    )


STATED = BodyAxes(
    np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]), stands_on_floor=True, are_stated=True
)
"""Axes of a LiDAR that tf says is mounted upside down."""


@pytest.mark.parametrize("axes", [AXES["lidar"], STATED])
@pytest.mark.parametrize("is_inverted", [True, False])
def test_the_floor_decides_between_the_accelerometer_and_the_mounting(is_inverted, axes):
    scans, trajectory, readings = street(is_inverted=is_inverted, imu_is_inverted=True)
    level = level_of(scans, trajectory, readings, axes=axes)
    assert level.T_level_world[2, 2] == pytest.approx(-1.0 if is_inverted else 1.0, abs=0.01)
    assert level.T_level_world[2, 3] == pytest.approx(1.7, abs=0.05)
    assert bool(level.conflict) == (axes is AXES["lidar"] or not is_inverted)
    assert level.is_decided


@pytest.mark.parametrize(("axes", "z_up"), [(AXES["lidar"], -1.0), (STATED, -1.0)])
def test_without_a_floor_a_stated_mounting_goes_before_the_accelerometer(axes, z_up):
    scans, trajectory, readings = street(
        is_inverted=True, has_ground=False, imu_is_inverted=axes is AXES["lidar"]
    )
    level = level_of(scans, trajectory, readings, axes=axes)
    assert level.T_level_world[2, 2] == pytest.approx(z_up, abs=0.05)
    assert level.conflict
    assert not level.is_decided


@pytest.mark.parametrize(("up", "z_up"), [("sensor", 1.0), ("accelerometer", -1.0)])
def test_the_user_can_say_which_way_is_up(up, z_up):
    scans, trajectory, readings = street(is_inverted=True, imu_is_inverted=True)
    level = level_of(scans, trajectory, readings, LevelConfig(up=up), axes=AXES["lidar"])
    assert level.T_level_world[2, 2] == pytest.approx(z_up, abs=0.05)


@pytest.mark.parametrize("is_inverted", [True, False])
@pytest.mark.parametrize("up", ["auto", "sensor", "z"])
def test_a_lidar_over_which_the_ground_is_seen_hangs_upside_down(is_inverted, up):
    scans, trajectory, _ = street(is_inverted=is_inverted, imu_is_inverted=False)
    level = level_of(scans, trajectory, config=LevelConfig(up=up), axes=AXES["lidar"])
    assert ("level.up=-z" in level.conflict) == (is_inverted and up == "auto") == (not level.is_decided)
    assert ("the sensor's z axis, as nothing states it" in level.detail) == (up == "auto")


def test_a_lidar_between_floor_and_ceiling_may_be_upright():
    scans, trajectory, _ = street(is_inverted=False, imu_is_inverted=False)
    below = scans[0][0].points_body
    both = np.concatenate([below, below * [1.0, 1.0, -1.0]]).astype(np.float32)
    level = level_of([(Scan(0, both), T) for _, T in scans], trajectory, axes=AXES["lidar"])
    assert not level.conflict
