"""Free space: what stands where earlier images saw through has moved, and a wrong pose displaces surfaces."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.frames import RgbdFrame
from mapper.core.geometry import exp
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.keyframes.depth_comparison import EarlierDepth
from mapper.runtime.state_file import dumps, loads
from tests.support.desk_frames import desk_frames

NOW = 40
"""Frame that is looked at: 1.3 s after the first."""


@pytest.fixture(scope="module")
def odometry():
    """The odometry at that frame; what changes it works on a copy."""
    odometry = build_frame_odometry(LocalMapConfig())
    for frame in desk_frames()[: NOW + 1]:
        odometry.track(odometry.observe(frame))
    return odometry


@pytest.fixture
def earlier_depth(odometry):
    return EarlierDepth(odometry._map, None)


def with_visitor(frame):
    """Return the frame with something flat at 0.6 of the depth in the middle third of the image."""
    depth_m = frame.depth_m.copy()
    height, width = depth_m.shape
    depth_m[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] *= 0.6
    return RgbdFrame(frame.stamp_ns, frame.image, depth_m, frame.camera, frame.T_body_camera)


def test_nothing_has_moved_in_a_still_scene(odometry, earlier_depth):
    pose = odometry._last
    assert earlier_depth.moved(pose.observation, pose.T_camera_world, pose.reference).mean() < 0.01


def test_what_came_into_view_has_moved(odometry, earlier_depth, frames):
    pose = odometry._last
    visited = odometry.observe(with_visitor(frames[NOW]))
    moved = earlier_depth.moved(visited, pose.T_camera_world, pose.reference)
    size_px = np.array(visited.size_px)
    inside = (np.abs(visited.pixels / size_px - 0.5) < 1 / 6).all(axis=1) & visited.has_depth
    assert inside.sum() > 20
    assert moved[inside].mean() > 0.8
    assert moved[~inside].mean() < 0.02


def test_a_visitor_gives_no_landmarks_and_no_support(odometry, frames):
    odometry = loads(dumps(odometry))
    visited = odometry.observe(with_visitor(frames[NOW + 1]))
    size_px = np.array(visited.size_px)
    odometry.track(visited)
    pose = odometry._last
    inside = (np.abs(pose.observation.pixels / size_px - 0.5) < 0.16).all(axis=1)
    assert (pose.landmark_of_feature[inside & pose.observation.has_depth] >= 0).mean() < 0.1


@pytest.mark.parametrize(("offset_m", "displaced"), [(0.0, False), (0.2, True)])
def test_a_wrong_pose_displaces_the_surfaces(odometry, earlier_depth, offset_m, displaced):
    pose = odometry._last
    T_camera_world = exp(np.zeros(3), np.array([0.0, 0.0, offset_m])) @ pose.T_camera_world
    found = earlier_depth.displacement(pose.observation, T_camera_world, pose.reference)
    assert (found.ratio > 0.4) == displaced
    if displaced:
        assert found.distance_m == pytest.approx(offset_m, abs=0.05)
        assert found.since_s >= 0.4


def test_without_older_keyframes_nothing_is_known(odometry, earlier_depth):
    pose = odometry._last
    origin_ns = odometry._map.keyframes[0].stamp_ns
    early = replace(pose.observation, stamp_ns=origin_ns + 100_000_000)
    assert not earlier_depth.moved(early, pose.T_camera_world, pose.reference).any()
    assert earlier_depth.displacement(early, pose.T_camera_world, pose.reference).ratio == 0.0


def test_the_depths_noise_counts_only_while_many_features_have_moved(odometry):
    observation = odometry._last.observation
    moved = np.zeros(len(observation), np.bool_)
    moved[: len(moved) // 30] = True
    assert observation.weights_among(moved) is observation.weights
    moved[: len(moved) // 10] = True
    assert observation.weights_among(moved) is observation.sensor_weights
