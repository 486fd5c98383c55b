"""Triangulation: features without depth become landmarks, and count by how uncertain they are."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import apply, exp
from mapper.core.trajectory import trajectory_from
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.local_map.landmarks.landmark_map import MIN_SHARED_LANDMARKS
from mapper.odometry.local_map.landmarks.ray_uncertainty import ray_slope, updated_ray_sigma_m
from mapper.odometry.local_map.pose.pose_tracker import project
from mapper.odometry.local_map.pose.triangulation import triangulated, weights_with_landmarks
from tests.support.desk_frames import ate_rmse_m

POINTS = 60
T_B_A = exp(np.array([0.02, -0.05, 0.01]), np.array([-0.5, 0.05, 0.1]))


@pytest.fixture
def observation(frames):
    odometry = build_frame_odometry(LocalMapConfig())
    return odometry.observe(frames[0])


def shown(observation, points_camera, bits, rng, noise_px=0.0):
    """Return an observation of points in a camera's axes by pixels alone."""
    pixels = project(np.eye(4), points_camera, observation.intrinsics)
    pixels += rng.normal(0.0, noise_px, pixels.shape) if noise_px else 0.0
    count = len(points_camera)
    return replace(
        observation,
        pixels=pixels,
        measured=np.column_stack([pixels, np.full(count, np.nan)]),
        depth_m=np.full(count, np.nan),
        octave=np.zeros(count, np.int32),
        bits=bits,
        weights=np.ones((count, 3)),
    )


def scene(rng, depth_m):
    points = np.column_stack([rng.uniform(-1.0, 1.0, (POINTS, 2)) * 0.4 * depth_m, np.full(POINTS, depth_m)])
    return points, rng.integers(0, 2**63, (POINTS, 4), np.uint64)


def test_points_are_found_where_they_are(observation):
    rng = np.random.default_rng(0)
    points, bits = scene(rng, 5.0)
    order = rng.permutation(POINTS)
    a = shown(observation, points, bits, rng)
    b = shown(observation, apply(T_B_A, points)[order], bits[order], rng)
    pairs, points_a, sigma_m = triangulated(a, b, np.arange(POINTS), np.arange(POINTS), T_B_A)
    assert len(pairs) > 0.9 * POINTS
    assert np.array_equal(order[pairs[:, 1]], pairs[:, 0])
    assert np.allclose(points_a, points[pairs[:, 0]], atol=1e-6)
    # σ_z = √2 σ z² / (f b), of a pixel in each image.
    assert sigma_m == pytest.approx(np.sqrt(2.0) * 25.0 / (observation.intrinsics[0] * 0.5), rel=0.3)


def test_their_errors_are_what_is_told(observation):
    rng = np.random.default_rng(1)
    points, bits = scene(rng, 5.0)
    misses = []
    for _ in range(40):
        a = shown(observation, points, bits, rng, noise_px=1.0)
        b = shown(observation, apply(T_B_A, points), bits, rng, noise_px=1.0)
        pairs, points_a, sigma_m = triangulated(a, b, np.arange(POINTS), np.arange(POINTS), T_B_A)
        misses.append((points_a - points[pairs[:, 0]])[:, 2] / sigma_m)
    assert np.std(np.concatenate(misses)) == pytest.approx(1.0, rel=0.15)


def test_only_features_that_may_pair_are_paired(observation):
    rng = np.random.default_rng(2)
    points, bits = scene(rng, 5.0)
    a = shown(observation, points, bits, rng)
    b = shown(observation, apply(T_B_A, points), bits, rng)
    pairs, _, _ = triangulated(a, b, np.arange(20), np.arange(10, POINTS), T_B_A)
    assert set(pairs[:, 0]) <= set(range(10, 20))
    assert len(pairs) > 5


def test_points_off_the_epipolar_line_or_too_far_off_are_left_out(observation):
    rng = np.random.default_rng(3)
    points, bits = scene(rng, 5.0)
    features = np.arange(POINTS)
    a = shown(observation, points, bits, rng)
    elsewhere = apply(T_B_A, points) + np.array([0.0, 0.5, 0.0])  # as things that move
    assert not len(triangulated(a, shown(observation, elsewhere, bits, rng), features, features, T_B_A)[0])
    far, bits = scene(rng, 300.0)
    b = shown(observation, apply(T_B_A, far), bits, rng)
    assert not len(triangulated(shown(observation, far, bits, rng), b, features, features, T_B_A)[0])
    assert not len(triangulated(a, a, features, features, np.eye(4))[0])  # nothing moved


def test_the_shift_along_a_ray_is_the_derivative_of_the_projection(observation):
    rng = np.random.default_rng(4)
    points, rays = rng.uniform(-1.0, 1.0, (20, 3)) + np.array([0.0, 0.0, 4.0]), rng.normal(size=(20, 3))
    step = 1e-5 * rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def measured(points):
        z = apply(T_B_A, points)[:, 2]
        return np.column_stack(
            [project(T_B_A, points, observation.intrinsics), observation.intrinsics[4] / z]
        )

    slope = ray_slope(T_B_A, points, rays, observation.intrinsics)
    assert np.allclose(
        slope, (measured(points + step) - measured(points - step)) / 2e-5, rtol=1e-4, atol=1e-4
    )


def test_more_observations_make_a_landmark_more_certain(observation):
    points, rays = np.array([[0.0, 0.0, 5.0]] * 2), np.array([[0.0, 0.0, 1.0]] * 2)
    poses = np.array([exp(np.zeros(3), np.array([-x, 0.0, 0.0])) for x in (0.0, 0.5, 0.5)])
    edges = np.array([[k, p] for p in range(2) for k in range(3)])
    measured, weights = np.full((6, 3), np.nan), np.ones((6, 3))
    measured[:, :2] = 0.0
    arguments = rays, poses, points
    two, not_triangulated = updated_ray_sigma_m(
        np.array([1.0, 0.0]), *arguments, edges[:2], measured[:2], weights[:2], observation.intrinsics
    )
    assert two == pytest.approx(25.0 / (observation.intrinsics[0] * 0.5), rel=0.01)
    assert not_triangulated == 0.0
    three = updated_ray_sigma_m(
        np.ones(2), *arguments, edges[:3], measured[:3], weights[:3], observation.intrinsics
    )
    assert three == pytest.approx([two / np.sqrt(2.0), 1.0])


@pytest.fixture
def near_sighted(frames):
    """An odometry that saw the walk by a sensor that reaches a third of what is in view."""
    return track(frames, triangulate=True)


def track(frames, *, triangulate, **settings):
    limit_m = float(np.quantile(frames[0].depth_m[frames[0].depth_m > 0.0], 0.35))
    odometry = build_frame_odometry(LocalMapConfig(align_depth=False, triangulate=triangulate, **settings))
    near = [replace(f, depth_m=np.where(f.depth_m > limit_m, 0.0, f.depth_m)) for f in frames]
    return odometry, [odometry.track(odometry.observe(frame)) for frame in near]


def test_what_is_beyond_the_sensors_range_is_triangulated(near_sighted, frames, source):
    odometry, tracks = near_sighted
    sigma_m = odometry._map.landmarks["ray_sigma_m"][np.arange(odometry._map.landmarks.size)]
    assert (sigma_m > 0.0).sum() > 100
    assert all(track.node is not None for track in tracks)
    error_m, by_depth_alone_m = (
        ate_rmse_m(trajectory_from((t.stamp_ns, t.T_world_body) for t in each), source.truth)
        for each in (tracks, track(frames, triangulate=False)[1])
    )
    assert error_m < 0.01
    assert error_m < 0.9 * by_depth_alone_m


def test_every_list_of_observations_is_its_landmarks_own(near_sighted):
    """A feature that was unlinked stays in its landmark's list, so it may not enter another one."""
    landmark_map = near_sighted[0]._map
    ids = np.arange(landmark_map.landmarks.size, dtype=np.int32)
    first, observations = landmark_map._observations_of(ids)
    owners = np.repeat(ids, np.diff(first))
    assert np.array_equal(landmark_map._observations["landmark"][observations], owners)
    assert np.array_equal(landmark_map.landmarks["observers"][ids], np.diff(first))


def test_a_triangulated_landmark_counts_less_the_farther_it_is_seen_from_aside(near_sighted):
    odometry, _ = near_sighted
    landmark_map = odometry._map
    index = len(landmark_map.keyframes) - 1
    observation, ids = landmark_map.observation(index), landmark_map.landmark_of_feature(index)
    features = np.flatnonzero((ids >= 0) & (landmark_map.landmarks["ray_sigma_m"][ids] > 0.0))
    measured = np.flatnonzero((ids >= 0) & (landmark_map.landmarks["ray_sigma_m"][ids] == 0.0))
    both = np.concatenate([features, measured])
    T_camera_world = landmark_map.keyframes[index].T_camera_world

    def weights(aside_m):
        T = exp(np.zeros(3), np.array([aside_m, 0.0, 0.0])) @ T_camera_world
        return weights_with_landmarks(landmark_map, T, observation, both, ids[both], observation.weights)

    here, aside = weights(0.0), weights(1.0)
    assert np.array_equal(aside[measured], observation.weights[measured])
    assert (aside[features, 0] < observation.weights[features, 0]).all()
    assert np.median(aside[features, 0] / here[features, 0]) < 0.7


def test_triangulated_landmarks_do_not_outvote_features_that_measure_the_scale(near_sighted):
    odometry, _ = near_sighted
    landmark_map = odometry._map
    index = len(landmark_map.keyframes) - 1
    observation, ids = landmark_map.observation(index), landmark_map.landmark_of_feature(index)
    is_triangulated = landmark_map.landmarks["ray_sigma_m"][ids] > 0.0
    triangulated_ones = np.flatnonzero((ids >= 0) & is_triangulated)
    measured = np.flatnonzero((ids >= 0) & ~is_triangulated & observation.has_depth)
    assert len(measured) >= 20

    def added_variances(features):
        T = exp(np.zeros(3), np.array([0.3, 0.0, 0.0])) @ landmark_map.keyframes[index].T_camera_world
        weights = weights_with_landmarks(
            landmark_map, T, observation, features, ids[features], observation.weights
        )
        return (1.0 / weights - 1.0 / observation.weights)[triangulated_ones, 0]

    alone = added_variances(np.concatenate([triangulated_ones, measured[:19]]))
    beside = added_variances(np.concatenate([triangulated_ones, measured]))
    assert (beside > 0.2 * len(triangulated_ones) * alone).all()


@pytest.mark.parametrize("triangulate", [True, False])
def test_keyframes_that_place_triangulated_landmarks_are_adjusted_beyond_the_window(frames, triangulate):
    odometry, _ = track(frames, triangulate=triangulate, keyframe_ratio=1.0)
    landmark_map = odometry._map
    index = len(landmark_map.keyframes) - 1
    ids = landmark_map.landmarks_of(index)
    shared = landmark_map.shared_counts(ids[landmark_map.landmarks["ray_sigma_m"][ids] > 0.0])
    keyframes = landmark_map.keyframes
    before = [keyframe.T_camera_world for keyframe in keyframes]
    covisible = [k for k, _ in landmark_map.covisible(index, min_shared=MIN_SHARED_LANDMARKS)]
    landmark_map.refine(index, window=2)
    moved = {
        k for k, T in enumerate(before) if not np.array_equal(T, landmark_map.keyframes[k].T_camera_world)
    }
    placing = [k for k in covisible[1:] if shared[k] >= MIN_SHARED_LANDMARKS]
    assert bool(placing) == triangulate
    assert moved == {index, covisible[0], *placing[:4]} - {0}
