"""Free space: what stands where earlier images saw through has moved, and a wrong pose displaces surfaces."""

import pickle
from dataclasses import replace
from itertools import pairwise
from unittest.mock import Mock

import numpy as np
import pytest

from mapper.core.frames import RgbdFrame
from mapper.core.geometry import exp
from mapper.odometry.local_map.depth.earlier_depth import EarlierDepth
from tests.support.desk_frames import odometry_after

NOW = 40
"""Frame that is looked at: 1.3 s after the first."""
STILL = np.zeros(6)


@pytest.fixture
def odometry(frames):
    return odometry_after(frames[: NOW + 1])


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


def test_most_features_on_a_visitor_have_moved_where_most_surfaces_stand(odometry, earlier_depth, frames):
    pose = odometry._last
    visited = odometry.observe(with_visitor(frames[NOW]))
    moved = earlier_depth.moved(visited, pose.T_camera_world, pose.reference)
    shirt = np.tile(visited.points_camera[moved], (100, 1))[: 9 * len(visited)]
    points_camera = np.concatenate([visited.points_camera, shirt])
    crowded = replace(visited, points_camera=points_camera)
    assert earlier_depth.moved(crowded, pose.T_camera_world, pose.reference)[len(visited) :].all()


def test_who_came_and_stands_is_remembered(odometry):
    observation = odometry._last.observation
    landmark_map = Mock()
    landmark_map.observation.return_value = observation
    stamps_ns = [round(200_000_000 * k) for k in range(100)]
    landmark_map.keyframes = [Mock(stamp_ns=stamp_ns, origin=0, doubt_m=0.0) for stamp_ns in stamps_ns]
    now = replace(observation, stamp_ns=stamps_ns[-1])
    compared = EarlierDepth(landmark_map, None)._earlier(now, len(stamps_ns) - 1, most=10)
    ages_s = [1e-9 * (now.stamp_ns - stamps_ns[k]) for k in compared]
    assert ages_s[0] == pytest.approx(0.4)
    assert ages_s[-1] > 10.0
    assert all(later > 1.49 * sooner for sooner, later in pairwise(ages_s))


def test_a_visitor_gives_no_landmarks_and_no_support(odometry, frames):
    visited = odometry.observe(with_visitor(frames[NOW + 1]))
    size_px = np.array(visited.size_px)
    odometry.track(visited)
    pose = odometry._last
    inside = (np.abs(pose.observation.pixels / size_px - 0.5) < 0.16).all(axis=1)
    assert (pose.landmark_of_feature[inside & pose.observation.has_depth] >= 0).mean() < 0.1


def test_a_visitor_is_not_in_the_view_for_loops(odometry, frames):
    visited = odometry.observe(with_visitor(frames[NOW + 1]))
    before = odometry.view(visited)
    assert len(before) == len(visited)  # before it is tracked nothing is known to move
    odometry.track(visited)
    moving = odometry._last.moving
    assert len(moving) > 20

    seen = odometry.view(visited)
    assert np.array_equal(seen.pixels, np.delete(before.pixels, moving, axis=0))
    assert np.array_equal(seen.bits, np.delete(before.bits, moving, axis=0))
    assert len(seen.points_camera) == len(seen.sigma_px) == len(seen)
    written = pickle.loads(pickle.dumps(seen))
    assert np.array_equal(written.pixels, seen.pixels)
    assert np.array_equal(written.bits, seen.bits)


@pytest.mark.parametrize(("offset_m", "displaced"), [(0.0, False), (0.2, True)])
def test_a_wrong_pose_displaces_the_surfaces(odometry, earlier_depth, offset_m, displaced):
    pose = odometry._last
    T_camera_world = exp(np.zeros(3), np.array([0.0, 0.0, offset_m])) @ pose.T_camera_world
    found = earlier_depth.displacement(pose.observation, T_camera_world, pose.reference, STILL)
    assert (found.ratio > 0.4) == displaced
    if displaced:
        assert found.distance_m == pytest.approx(offset_m, abs=0.05)
        assert found.since_s >= 0.4


@pytest.mark.parametrize(
    ("change_mps", "displaced"), [(0.0, True), (0.5, True), (3.0, False)], ids=["steady", "slower", "faster"]
)
def test_surfaces_shift_while_the_depth_image_is_not_measured_yet(
    odometry, earlier_depth, change_mps, displaced
):
    """Depth that is late shifts by the time times the difference of the velocities in the two images."""
    pose, keyframes = odometry._last, odometry._map.keyframes
    late = exp(np.zeros(3), np.array([0.0, 0.0, 0.07])) @ pose.T_camera_world
    for keyframe in keyframes:
        keyframe.twist_camera = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    twist_camera = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0 + change_mps])
    found = earlier_depth.displacement(pose.observation, late, pose.reference, twist_camera)
    assert (found.ratio > 0.4) == displaced
    assert earlier_depth.displacement(pose.observation, late, pose.reference, None).ratio > 0.4


def test_what_moves_near_by_does_not_displace_the_farther_surfaces(odometry, earlier_depth, frames):
    pose, frame = odometry._last, frames[NOW]
    moved_m = np.where(frame.depth_m < np.nanmedian(frame.depth_m), frame.depth_m - 0.2, frame.depth_m)
    moved = odometry.observe(
        RgbdFrame(frame.stamp_ns, frame.image, moved_m, frame.camera, frame.T_body_camera)
    )
    found = earlier_depth.displacement(moved, pose.T_camera_world, pose.reference, STILL)
    assert found.ratio > 0.3
    assert found.far_ratio < 0.1


def test_without_older_keyframes_nothing_is_known(odometry, earlier_depth):
    pose = odometry._last
    origin_ns = odometry._map.keyframes[0].stamp_ns
    early = replace(pose.observation, stamp_ns=origin_ns + 100_000_000)
    assert not earlier_depth.moved(early, pose.T_camera_world, pose.reference).any()
    assert earlier_depth.displacement(early, pose.T_camera_world, pose.reference, STILL).ratio == 0.0
