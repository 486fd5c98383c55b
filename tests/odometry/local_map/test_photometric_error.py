"""Photometric error: an image tells which of two motions is the camera's, though its features do not."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import exp
from mapper.odometry.local_map.photometric_error import excess_error
from tests.support.desk_frames import odometry_after

NOW = 40


@pytest.fixture
def poses(frames):
    """Return the tracked poses of two frames, the later one first."""
    odometry = odometry_after(frames[:NOW])
    before = odometry._last
    odometry.track(odometry.observe(frames[NOW]))
    return odometry._last, before


def off(pose, *, turn_rad=0.0, shift_m=0.0):
    """Return the pose of a camera that is turned and shifted to its side."""
    T_off = exp(np.array([0.0, turn_rad, 0.0]), np.array([shift_m, 0.0, 0.0]))
    return replace(pose, T_camera_world=T_off @ pose.T_camera_world)


@pytest.mark.parametrize("error", [{"turn_rad": 0.02}, {"shift_m": 0.05}])
def test_a_right_pose_is_preferred(poses, error):
    now, before = poses
    wrong = off(now, **error)
    assert excess_error(wrong, before, now.T_camera_world) > 10.0
    assert excess_error(now, before, wrong.T_camera_world) < -10.0


def test_brightness_that_changes_everywhere_does_not_matter(poses):
    now, before = poses
    grey = now.observation.grey_cells
    wrong = off(now, turn_rad=0.02)
    brighter = replace(wrong, observation=replace(wrong.observation, grey_cells=grey // 2 + 100))
    assert excess_error(brighter, before, now.T_camera_world) > 10.0


def test_something_that_moves_by_itself_is_no_camera_motion(poses):
    """A third of the image shows what a camera turned by 0.05 rad would show: the rest decides."""
    now, before = poses
    grey = now.observation.grey_cells.copy()
    third = slice(0, grey.shape[1] // 3)
    turned = off(now, turn_rad=0.05)
    grey[:, third] = np.roll(before.observation.grey_cells, -3, axis=1)[:, third]
    crossed = replace(turned, observation=replace(now.observation, grey_cells=grey))
    assert excess_error(crossed, before, now.T_camera_world) > 4.0


def test_nothing_is_preferred_where_nothing_can_be_compared(poses):
    now, before = poses
    turned, away = (off(now, turn_rad=turn_rad).T_camera_world for turn_rad in (0.02, 1.5))
    cells = now.observation.depth_cells
    empty = replace(cells, inverse_depth=np.zeros_like(cells.inverse_depth))
    blind = replace(now, observation=replace(now.observation, depth_cells=empty))
    assert excess_error(now, before, None) == 0.0
    assert excess_error(now, before, now.T_camera_world) == 0.0
    assert excess_error(now, before, away) == 0.0
    assert excess_error(blind, before, turned) == 0.0
