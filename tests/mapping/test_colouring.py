"""Colours of scans by the images of cameras beside the LiDAR."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import FrameError
from mapper.core.frames import PinholeCamera
from mapper.core.geometry import exp, inverse, transform
from mapper.core.trajectory import Trajectory
from mapper.mapping.cloud_building import ScanColouring
from mapper.sources.base import CameraImages

CAMERA = PinholeCamera(160, 120, 100.0, 100.0, 79.5, 59.5, (-0.2, 0.05, 0.001, -0.001, 0.0))
T_BODY_CAMERA = transform(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.2, 0.3])
)
STILL = Trajectory(np.array([0, 100_000_000]), np.array([np.eye(4)] * 2))
COLUMNS, ROWS = np.meshgrid(np.arange(160), np.arange(120))
PICTURE = np.dstack([COLUMNS, ROWS, np.full_like(ROWS, 7)]).astype(np.uint8)


def images(*stamps_ns, T_body_camera=T_BODY_CAMERA, read=lambda _: PICTURE):
    return CameraImages("front", np.array(stamps_ns), CAMERA, T_body_camera, read)


def wall(x_m, half_m, step_m=0.1):
    y, z = np.meshgrid(*[np.arange(-half_m, half_m, step_m)] * 2)
    return np.column_stack([np.full(y.size, x_m), y.ravel(), z.ravel()]).astype(np.float32)


def test_points_have_the_colours_of_their_raw_pixels():
    points = wall(4.0, 1.5)
    colors, is_seen = ScanColouring([images(0)], STILL).colour(points, 0)

    in_camera = points @ T_BODY_CAMERA[:3, :3] - T_BODY_CAMERA[:3, :3].T @ T_BODY_CAMERA[:3, 3]
    pixels = CAMERA.distort(CAMERA.project(in_camera))
    assert is_seen.all()
    assert np.abs(colors[:, :2] - pixels).max() <= 0.51
    assert (colors[:, 2] == 7).all()


def test_what_lies_behind_or_beside_has_none():
    points = np.array([[-4.0, 0.0, 0.0], [0.5, 40.0, 0.0], [4.0, 0.0, 0.0]], np.float32)
    _, is_seen = ScanColouring([images(0)], STILL).colour(points, 0)
    assert is_seen.tolist() == [False, False, True]


def test_a_board_covers_the_wall_behind_it():
    board, behind = wall(2.0, 0.4, 0.05), wall(4.0, 1.5)
    _, is_seen = ScanColouring([images(0)], STILL).colour(np.concatenate([board, behind]), 0)

    camera_m = T_BODY_CAMERA[:3, 3]
    at_board = camera_m + (behind - camera_m) * ((2.0 - camera_m[0]) / (4.0 - camera_m[0]))
    off_m = np.abs(at_board[:, 1:]).max(axis=1)
    seen = is_seen[len(board) :]
    assert is_seen[: len(board)].mean() > 0.99
    assert not seen[off_m < 0.25].any()
    assert seen[off_m > 0.6].all()


def test_ground_before_a_car_covers_none_of_itself():
    x, y = np.meshgrid(np.geomspace(7.0, 40.0, 120), np.linspace(-2.0, 2.0, 160))
    ground = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.5)]).astype(np.float32)
    camera = PinholeCamera(1242, 375, 720.0, 720.0, 610.0, 173.0)
    front = replace(images(0, read=lambda _: np.zeros((375, 1242, 3), np.uint8)), camera=camera)
    _, is_seen = ScanColouring([front], STILL).colour(ground, 0)
    assert is_seen.mean() > 0.97


def test_images_are_seen_from_the_pose_of_their_time():
    moving = Trajectory(
        np.array([0, 100_000_000]), np.array([np.eye(4), exp(np.zeros(3), np.array([0.0, 2.0, 0.0]))])
    )
    shifted = STILL.moved(exp(np.zeros(3), np.array([0.0, 1.0, 0.0])))
    points = wall(4.0, 1.0)
    half_way, _ = ScanColouring([images(50_000_000)], moving).colour(points, 40_000_000)
    there, _ = ScanColouring([images(50_000_000)], shifted).colour(points, 40_000_000)
    np.testing.assert_array_equal(half_way, there)


def test_scans_a_second_apart_are_coloured():
    slow = Trajectory(np.array([0, 1_000_000_000]), np.array([np.eye(4)] * 2))
    _, is_seen = ScanColouring([images(20_000_000)], slow).colour(wall(4.0, 1.0), 0)
    assert is_seen.all()


@pytest.mark.parametrize("stamp_ns", [600_000_000, 5_000_000_000])
def test_images_far_from_a_scan_or_from_the_path_colour_nothing(stamp_ns):
    _, is_seen = ScanColouring([images(stamp_ns)], STILL).colour(wall(4.0, 1.0), 0)
    assert not is_seen.any()


def test_the_first_camera_that_sees_a_point_colours_it_and_damaged_images_do_not():
    def damaged(_):
        raise FrameError("damaged")

    turned = exp(np.array([0.0, 0.0, np.pi]), np.zeros(3)) @ T_BODY_CAMERA
    grey = images(0, T_body_camera=turned, read=lambda _: np.full((120, 160), 99, np.uint8))
    points = np.concatenate([wall(4.0, 1.0), wall(-4.0, 1.0)])
    colors, is_seen = ScanColouring([images(0, read=damaged), images(0), grey], STILL).colour(points, 0)
    assert is_seen.all()
    assert (colors[points[:, 0] < 0.0] == 99).all()
    assert (colors[points[:, 0] > 0.0, 2] == 7).all()
    assert inverse(T_BODY_CAMERA)[2, 3] < 0.0
