"""Features that move: followed from frame to frame, spread over their body, and what they hide."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.frames import RgbdFrame
from mapper.core.geometry import apply, exp, inverse
from mapper.odometry.local_map.depth.earlier_depth import Displacement, EarlierDepth, hidden_points
from mapper.odometry.local_map.pose.moving_features import among_moving
from tests.support.desk_frames import odometry_after

NOW = 40
WALKED_M = np.array([0.08, 0.0, 0.0])


@pytest.fixture
def odometry(frames):
    return odometry_after(frames[: NOW + 1])


@pytest.fixture
def body(odometry):
    """The features with depth in the middle third of the last frame's columns."""
    observation = odometry._last.observation
    across = observation.pixels[:, 0] / observation.size_px[0]
    return (np.abs(across - 0.5) < 1 / 6) & observation.has_depth


def moving_now(odometry, body, *, walked_m, known):
    """Return which features move in a frame like the last one, if ``known`` ones of a body moved before."""
    last = odometry._last
    points_camera = last.observation.points_camera.copy()
    points_camera[body] -= walked_m
    before = replace(
        last,
        observation=replace(last.observation, points_camera=points_camera),
        moving=np.flatnonzero(known).astype(np.int32),
    )
    nothing = np.zeros(len(body), np.bool_)
    is_still = (last.landmark_of_feature >= 0) & ~body
    tracker = odometry._estimator._tracker
    return tracker._moving.moving(last.T_camera_world, last.observation, before, nothing, is_still)


def test_who_walked_is_followed_with_the_features_that_did_not_match(odometry, body):
    known = body & (np.arange(len(body)) % 3 > 0)
    is_moving = moving_now(odometry, body, walked_m=WALKED_M, known=known)
    assert is_moving[body].mean() > 0.8
    assert is_moving[body & ~known].mean() > 0.7
    assert is_moving[~body].mean() < 0.1


def test_who_stands_again_does_not_move(odometry, body):
    assert moving_now(odometry, body, walked_m=0.0 * WALKED_M, known=body).mean() < 0.02


def test_few_features_are_not_followed(odometry, body):
    assert moving_now(odometry, body, walked_m=WALKED_M, known=body & (np.cumsum(body) < 20)) is None


def test_a_mismatch_on_a_wall_is_outvoted():
    features = np.array([[0.05 * k, 0.0, 3.0] for k in range(10)])
    mismatch = np.arange(10) == 4
    assert not among_moving(features, features, mismatch, ~mismatch).any()
    points = np.array([[0.2, 0.1, 3.0], [0.2, 0.0, 4.0], [np.nan, np.nan, np.nan]])
    assert among_moving(points, features, ~mismatch, mismatch).tolist() == [True, False, False]


def test_landmarks_behind_a_visitor_are_hidden(odometry, frames):
    frame, last = frames[NOW], odometry._last
    depth_m = frame.depth_m.copy()
    columns = slice(frame.camera.width_px // 3, 2 * frame.camera.width_px // 3)
    depth_m[:, columns] *= 0.6
    visited = odometry.observe(
        RgbdFrame(frame.stamp_ns, frame.image, depth_m, frame.camera, frame.T_body_camera)
    )
    observation = last.observation
    points_world = apply(inverse(last.T_camera_world), observation.points_camera)
    across = observation.pixels[:, 0] / observation.size_px[0]
    behind, beside = np.abs(across - 0.5) < 0.15, np.abs(across - 0.5) > 0.2
    hidden = hidden_points(visited, last.T_camera_world, points_world)
    assert hidden[behind & observation.has_depth].mean() > 0.5
    assert not hidden[beside].any()
    assert not hidden_points(observation, last.T_camera_world, points_world).any()


def test_among_moving_features_depth_has_its_own_noise(odometry):
    observation = odometry._last.observation.swept(np.full(6, 0.01))
    few, many = (np.arange(len(observation)) < share * len(observation) for share in (0.04, 0.06))
    assert observation.weights_among(few) is observation.weights
    assert observation.weights_among(many) is observation.sensor_weights
    assert observation.among_moving(few) is observation
    weighted = observation.among_moving(many)
    assert weighted.weights is observation.sensor_weights
    assert weighted.swept(np.full(6, 0.02)).weights is observation.sensor_weights


def test_moving_surfaces_do_not_count_as_displaced(odometry):
    last = odometry._last
    T_camera_world = exp(np.zeros(3), np.array([0.0, 0.0, 0.15])) @ last.T_camera_world
    cells = len(last.observation.depth_cells.points())

    def displacement(is_moving):
        compared = EarlierDepth(odometry._map, None)
        return compared.displacement(last.observation, T_camera_world, last.reference, None, is_moving)

    assert displacement(None).ratio > 0.5
    assert displacement(np.ones(cells, np.bool_)) == Displacement()
    assert last.moving_cells() is None
    crowded = replace(last, moving=np.arange(len(last.observation) // 2, dtype=np.int32))
    crowded.landmark_of_feature[crowded.moving] = -1
    assert 0.1 < crowded.moving_cells().mean() < 0.9
