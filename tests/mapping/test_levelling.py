from dataclasses import replace

import cv2
import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.core.frames import PinholeCamera, RgbdFrame, Scan
from mapper.core.geometry import apply, exp, inverse, rotation_exp, transform
from mapper.core.timebase import nearest, ns_from_seconds_text
from mapper.core.trajectory import Trajectory
from mapper.mapping.body_axes import AXES, axes_of
from mapper.mapping.config import LevelConfig
from mapper.mapping.levelling import level_in_plane
from mapper.mapping.wall_direction import wall_heading
from mapper.registration.planes import Patches
from mapper.sources.trajectory_files import read_tum
from tests.support.logs import log_in_memory
from tests.support.paths import FR1_XYZ
from tests.support.rooms import (
    DESK,
    FLOOR,
    MS,
    ROOM,
    WALLS,
    Rectangle,
    around,
    floor_height_m,
    level_of,
    log_of,
    pose,
    tilt_deg,
)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("down_deg", [0.0, 25.0, 50.0])
def test_a_room_is_levelled_from_any_world(seed, down_deg):
    scans, trajectory, T_world_room = log_of(ROOM, around(down_deg=down_deg), seed=seed)
    level = level_of(scans, trajectory)
    assert level.method == "planes"
    assert "floor seen" in level.detail
    assert tilt_deg(level, T_world_room) < 0.3
    assert abs(floor_height_m(level, T_world_room)) < 0.02


def test_the_first_pose_is_at_the_origin_and_faces_along_x():
    scans, trajectory, _ = log_of(ROOM, around())
    level = level_of(scans, trajectory, config=LevelConfig(heading="start"))
    T_level_first = level.T_level_world @ trajectory.T_world_body[0]
    np.testing.assert_allclose(T_level_first[:3, 3], [0.0, 0.0, 1.4], atol=0.02)
    heading = T_level_first[:3, :3] @ AXES["rgbd"].forward
    assert heading[0] > 0.8
    assert abs(heading[1]) < 1e-12
    assert (T_level_first[:3, :3] @ AXES["rgbd"].up)[2] > 0.8


@pytest.mark.parametrize("yaw_deg", [-40.0, 17.0, 63.0, 130.0])
def test_x_lies_along_walls(yaw_deg):
    T_other_room = exp(np.radians([0.0, 0.0, yaw_deg]), np.zeros(3))
    turned = [T_other_room @ one for one in around()]
    scans, trajectory, T_world_room = log_of(ROOM, turned)
    level = level_of(scans, trajectory)
    R_level_room = level.T_level_world[:3, :3] @ T_world_room[:3, :3]
    assert np.abs(R_level_room[0, :2]).max() > np.cos(np.radians(0.3))
    first = level.T_level_world @ trajectory.T_world_body[0]
    np.testing.assert_allclose(first[:3, 3], [0.0, 0.0, 1.4], atol=0.02)
    assert (first[:3, :3] @ AXES["rgbd"].forward)[0] > np.cos(np.radians(46.0)) * 0.9
    assert "x lies along walls" in level.detail


def test_a_camera_facing_straight_down_takes_its_heading_from_its_own_up():
    poses = [
        pose(x, 0.0, 1.4, yaw_deg=0.0, down_deg=d) for x, d in zip((0, 0.5, 1.0), (90, 30, 30), strict=True)
    ]
    scans, trajectory, _ = log_of(ROOM, poses)
    T_level_first = level_of(scans, trajectory).T_level_world @ trajectory.T_world_body[0]
    np.testing.assert_allclose(T_level_first[:3, :3] @ AXES["rgbd"].up, [1.0, 0.0, 0.0], atol=0.02)


def test_a_big_desk_is_not_taken_for_the_floor():
    poses = [pose(-0.4, y, 1.5, yaw_deg=0.0, down_deg=40.0) for y in np.linspace(-1, 1, 10)]
    poses += [pose(-0.4, 0.0, 1.5, yaw_deg=60.0, down_deg=40.0)] * 2
    scans, trajectory, T_world_room = log_of([DESK, FLOOR, WALLS[0]], poses)
    level = level_of(scans, trajectory)
    assert tilt_deg(level, T_world_room) < 0.5
    assert "floor seen" in level.detail
    assert abs(floor_height_m(level, T_world_room)) < 0.02


def test_a_desk_with_things_below_it_is_no_floor():
    poses = [pose(0.2, y, 1.5, yaw_deg=0.0, down_deg=50.0) for y in np.linspace(-0.5, 0.5, 10)]
    scans, trajectory, T_world_room = log_of([DESK], poses)
    rng = np.random.default_rng(0)
    clutter_room = rng.uniform([-0.5, -1.0, 0.0], [0.2, 1.0, 0.5], (200, 3))
    cluttered = [
        (
            Scan(
                s.stamp_ns,
                np.vstack([s.points_body, apply(inverse(T) @ T_world_room, clutter_room)]).astype("f4"),
            ),
            T,
        )
        for s, T in scans
    ]
    level = level_of(cluttered, trajectory)
    assert "no floor seen" in level.detail
    assert tilt_deg(level, T_world_room) < 0.5
    assert -0.1 < floor_height_m(level, T_world_room) < 0.05


def test_a_dominant_wall_in_front_of_a_camera_facing_down_is_not_up():
    floor_strip = Rectangle(2, 0.0, (1.6, -3.0), (2.0, 3.0))
    poses = [pose(1.0, y, 1.4, yaw_deg=5 * y, down_deg=35.0) for y in np.linspace(-1.5, 1.5, 10)]
    scans, trajectory, T_world_room = log_of([WALLS[0], floor_strip], poses)
    assert tilt_deg(level_of(scans, trajectory), T_world_room) < 0.5


def test_two_walls_are_enough():
    scans, trajectory, T_world_room = log_of(WALLS, around(down_deg=15.0))
    level = level_of(scans, trajectory)
    assert level.method == "planes"
    assert "no floor seen" in level.detail
    assert tilt_deg(level, T_world_room) < 0.5


def test_one_wall_determines_one_tilt_and_the_detail_reports_it():
    poses = [pose(0.0, y, 1.4, yaw_deg=0.0, down_deg=15.0, roll_deg=6.0) for y in np.linspace(-1, 1, 10)]
    scans, trajectory, T_world_room = log_of(WALLS[:1], poses)
    level = level_of(scans, trajectory)
    wall_normal_level = level.T_level_world[:3, :3] @ T_world_room[:3, 0]
    assert abs(np.degrees(np.arcsin(wall_normal_level[2]))) < 0.5
    assert tilt_deg(level, T_world_room) == pytest.approx(6.0, abs=1.0)
    assert "the tilt along them is the camera's" in level.detail


def test_without_any_plane_up_is_the_camera_s():
    rng = np.random.default_rng(0)
    trajectory = Trajectory(np.arange(4) * MS, np.array([pose(0, 0, 1, yaw_deg=0, down_deg=20)] * 4))
    cloud = Scan(0, rng.uniform(-2, 2, (4000, 3)).astype(np.float32))
    for scans in ([(cloud, T) for T in trajectory.T_world_body], []):
        level = level_of(scans, trajectory)
        assert level.method == "camera"
        np.testing.assert_allclose(
            level.T_level_world[2, :3], trajectory.T_world_body[0, :3, :3] @ AXES["rgbd"].up, atol=1e-12
        )
    assert "no points seen" in level.detail


def test_a_body_may_have_other_axes():
    R_camera_lidar = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # x forward, z up
    T_camera_lidar = transform(R_camera_lidar, np.zeros(3))
    scans, trajectory, T_world_room = log_of(ROOM, around())
    as_lidar = [
        (
            Scan(s.stamp_ns, apply(inverse(T_camera_lidar), s.points_body).astype(np.float32)),
            T @ T_camera_lidar,
        )
        for s, T in scans
    ]
    moved = Trajectory(trajectory.stamps_ns, trajectory.T_world_body @ T_camera_lidar)
    level = level_of(as_lidar, moved, axes=AXES["lidar"])
    assert tilt_deg(level, T_world_room) < 0.3
    assert (level.T_level_world @ moved.T_world_body[0])[0, 0] > 0.8


def on_robot(scene, T_room_cameras, *, footprint_m=0.0, known=slice(None), base_frame="a/base_link"):
    """Level by a camera that tf moves on a robot at rest, and the pose of the room."""
    scans, trajectory, T_world_room = log_of(scene, T_room_cameras)
    T_world_base = T_world_room @ exp(np.zeros(3), np.array([0.4, -0.3, footprint_m + 0.2]))
    T_body_base = Trajectory(trajectory.stamps_ns, np.linalg.inv(trajectory.T_world_body) @ T_world_base)
    log = log_in_memory([], T_body_base=T_body_base[known], base_frame=base_frame, base_height_m=0.2)
    return level_of(scans, trajectory, axes=axes_of(log, trajectory)), T_world_room


@pytest.mark.parametrize("known", [slice(None), slice(6, None)])
def test_a_floor_that_is_not_seen_is_the_robot_s_footprint(known):
    level, T_world_room = on_robot(WALLS, around(down_deg=15.0), known=known)
    assert level.has_floor
    assert abs(floor_height_m(level, T_world_room)) < 0.02


@pytest.mark.parametrize("footprint_m", [0.0, 0.1, -0.4, 0.4])
def test_a_floor_that_is_seen_goes_before_the_robot_s_footprint(footprint_m):
    level, T_world_room = on_robot(ROOM, around(), footprint_m=footprint_m)
    assert abs(floor_height_m(level, T_world_room)) < 0.02
    assert bool(level.conflict) == (abs(footprint_m) > 0.3)
    assert level.is_decided


@pytest.mark.parametrize(("base_frame", "tilt"), [("base_link", 0.0), ("gripper", 50.0)])
def test_without_any_plane_up_is_the_robot_s_below_a_camera_that_tilts(base_frame, tilt):
    poses = [pose(0.0, 0.0, 1.4, yaw_deg=0.0, down_deg=d) for d in np.linspace(40.0, 60.0, 5)]
    level, T_world_room = on_robot([], poses, base_frame=base_frame)
    assert level.method == "camera"
    assert tilt_deg(level, T_world_room) == pytest.approx(tilt, abs=1.0)


@pytest.mark.parametrize(("footprint_m", "layer_m"), [(0.0, 0.2), (-0.14, 0.35)])
def test_a_laser_s_plane_is_as_high_as_it_is_above_the_robot_s_footprint(footprint_m, layer_m):
    path = Trajectory(np.arange(2) * MS, np.array([np.eye(4)] * 2))
    ring = Scan(0, np.zeros((1, 3), np.float32), origin_body=np.array([0.1, 0.0, 0.22]), is_planar=True)
    level = level_in_plane(
        [(ring, path[0])],
        trajectory=path,
        config=LevelConfig(heading="start"),
        axes=replace(AXES["lidar-2d"], floor_world=np.array([[0.0, 0.0, footprint_m]])),
        resolution_m=0.05,
    )
    assert level.T_level_world[2, 3] + 0.22 == pytest.approx(layer_m + 0.05 / 3.0)


def test_a_log_without_poses_is_refused():
    with pytest.raises(DataError, match="no poses"):
        level_of([], Trajectory(np.empty(0, np.int64), np.empty((0, 4, 4))))


@pytest.mark.skipif(not FR1_XYZ.is_dir(), reason=f"{FR1_XYZ} is not here")
def test_a_real_desk_is_levelled_as_by_motion_capture():
    truth = read_tum(FR1_XYZ / "groundtruth.txt")
    camera = PinholeCamera(640, 480, 517.3, 516.5, 318.6, 255.3)
    rows = [line.split() for line in (FR1_XYZ / "depth.txt").read_text().splitlines() if line[0] != "#"]
    scans = []
    for stamp_text, name in rows[10:790:26]:
        stamp_ns = ns_from_seconds_text(stamp_text)
        index, _ = nearest(truth.stamps_ns, np.array([stamp_ns]))
        depth_m = cv2.imread(str(FR1_XYZ / name), cv2.IMREAD_UNCHANGED).astype(np.float32) / 5000.0
        frame = RgbdFrame(stamp_ns, np.zeros((480, 640), np.uint8), depth_m, camera)
        scans.append((frame.scan(stride_px=8, max_depth_m=4.0), truth.T_world_body[index[0]]))

    level = level_of(
        scans, Trajectory(np.array([s.stamp_ns for s, _ in scans]), np.array([T for _, T in scans]))
    )

    # The camera looks down by 44°. Seen through the truth, the floor itself leans by 2.4° against the
    # truth's z axis (a plane fitted to 25 000 floor points), so no closer agreement can be asked for.
    up_truth = level.T_level_world[2, :3]
    assert level.method == "planes"
    assert np.degrees(np.arccos(up_truth[2])) < 3.0
    floor_truth = np.array([0.03046, -0.02864, 0.99913])
    assert np.degrees(np.linalg.norm(np.cross(up_truth, floor_truth))) < 0.7
    assert -level.T_level_world[2, 3] / up_truth[2] == pytest.approx(0.0, abs=0.1)


UP = np.array([0.0, 0.0, 1.0])


def upright(angles_rad):
    normals = np.column_stack([np.cos(angles_rad), np.sin(angles_rad), np.zeros(len(angles_rad))])
    return Patches(np.zeros((len(angles_rad), 3)), normals)


@pytest.mark.parametrize("heading_deg", [-44.0, -10.0, 0.0, 31.3, 44.9])
def test_walls_of_four_directions_share_a_heading(heading_deg):
    rng = np.random.default_rng(1)
    walls_deg = heading_deg + 90.0 * rng.integers(0, 4, 120) + rng.normal(0.0, 1.5, 120)
    clutter_deg = rng.uniform(0.0, 360.0, 60)
    found = wall_heading(upright(np.radians(np.concatenate([walls_deg, clutter_deg]))), np.eye(3))
    assert found.determined
    assert np.degrees(found.angle_rad) == pytest.approx(heading_deg, abs=0.6)


def test_normals_in_all_directions_have_no_heading():
    angles_rad = np.random.default_rng(2).uniform(0.0, 2.0 * np.pi, 400)
    assert not wall_heading(upright(angles_rad), np.eye(3)).determined


def test_few_walls_and_none_have_no_heading():
    assert not wall_heading(upright(np.zeros(12)), np.eye(3)).determined
    level = Patches(np.zeros((50, 3)), np.tile(UP, (50, 1)))
    assert wall_heading(level, np.eye(3)).upright == 0


def test_the_vertical_is_the_level_frame_s():
    R_level_world = rotation_exp(np.array([0.4, -0.2, 0.0]))
    patches = upright(np.radians(20.0 + 90.0 * np.arange(60)))
    world = Patches(patches.centres_world, patches.normals_world @ R_level_world)
    assert np.degrees(wall_heading(world, R_level_world).angle_rad) == pytest.approx(20.0, abs=0.1)
