"""Compiled pose refinement and bundle adjustment on points whose truth is known."""

import numpy as np
import pytest

from mapper.core.geometry import angle_between, apply, exp, inverse
from mapper.core.linear import twist_exp
from mapper.odometry.keyframes.bundle_adjustment import adjust
from mapper.registration.reprojection import normal_matrix, refine_pose

INTRINSICS = np.array([525.0, 525.0, 319.5, 239.5, 40.0])
NO_LINKS = np.empty((0, 2), np.int32), np.empty((0, 4, 4)), np.empty((0, 6, 6))


def measure(T_camera_world, points_world, rng, *, noise_px=0.0):
    points_camera = apply(T_camera_world, points_world)
    x, y, z = points_camera.T
    measured = np.column_stack(
        [INTRINSICS[0] * x / z + INTRINSICS[2], INTRINSICS[1] * y / z + INTRINSICS[3], INTRINSICS[4] / z]
    )
    return measured + rng.normal(0.0, noise_px, measured.shape), points_camera


def points_ahead(rng, n):
    return rng.uniform([-1.5, -1.0, 1.0], [1.5, 1.0, 4.0], (n, 3))


def random_pose(rng, *, translation_m, rotation_rad):
    return exp(rng.normal(0, rotation_rad, 3), rng.normal(0, translation_m, 3))


def test_twist_exp_agrees_with_the_exponential_map():
    rng = np.random.default_rng(0)
    T = random_pose(rng, translation_m=1.0, rotation_rad=1.0)
    for size in (1e-12, 1e-3, 2.0):
        delta = rng.normal(0, size, 6)
        assert np.allclose(twist_exp(delta, T), exp(delta[:3], delta[3:]) @ T, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_pose_survives_outliers_and_missing_depth(seed):
    rng = np.random.default_rng(seed)
    points = points_ahead(rng, 300)
    truth = random_pose(rng, translation_m=0.1, rotation_rad=0.05)
    measured, _ = measure(truth, points, rng, noise_px=0.5)
    outlier = np.arange(300) < 75
    measured[outlier, :2] += rng.uniform(20, 80, (75, 2))
    measured[::3, 2] = np.nan

    found, inlier, _ = refine_pose(np.eye(4), points, measured, np.ones((300, 3)), INTRINSICS, 3, 8)

    assert np.linalg.norm((inverse(truth) @ found)[:3, 3]) < 0.004
    assert angle_between(truth[:3, :3], found[:3, :3]) < 0.002
    assert not inlier[outlier].any()
    assert inlier[~outlier].mean() > 0.97


def test_normal_matrix_predicts_the_spread_of_estimates():
    """The inverse of the information is the covariance that repeated noise really produces."""
    rng = np.random.default_rng(9)
    points = points_ahead(rng, 120)
    weights = np.ones((120, 3))
    truth = np.eye(4)
    errors = []
    for _ in range(150):
        measured, _ = measure(truth, points, rng, noise_px=1.0)
        found, _, _ = refine_pose(truth, points, measured, weights, INTRINSICS, 1, 8)
        errors.append(found[:3, 3])
    exact, _ = measure(truth, points, rng)
    predicted = np.linalg.inv(normal_matrix(truth, points, exact, weights, INTRINSICS))
    assert np.allclose(np.std(errors, axis=0), np.sqrt(np.diag(predicted)[3:]), rtol=0.25)


def bundle(rng, *, cameras=5, points=200, noise_px=0.5):
    points_world = points_ahead(rng, points)
    truth = np.array([exp(rng.normal(0, 0.03, 3), [0.1 * c, 0.0, 0.0]) for c in range(cameras)])
    edges, measured = [], []
    for p in range(points):
        for c in range(cameras):
            edges.append((c, p))
            measured.append(measure(truth[c], points_world[p : p + 1], rng, noise_px=noise_px)[0][0])
    first = np.arange(points + 1, dtype=np.int32) * cameras
    return truth, points_world, first, np.array(edges, np.int32), np.array(measured)


def test_bundle_moves_poses_and_points_back_to_the_truth():
    rng = np.random.default_rng(1)
    truth, points, first, edges, measured = bundle(rng)
    wrong = rng.choice(len(edges), 40, replace=False)
    measured[wrong, :2] += 50.0
    start = np.array(
        [truth[0], *(random_pose(rng, translation_m=0.02, rotation_rad=0.01) @ T for T in truth[1:])]
    )
    free = np.array([-1, 0, 1, 2, 3], np.int32)
    start_points = points + rng.normal(0, 0.03, points.shape)

    poses, refined, agree = adjust(
        start,
        free,
        start_points,
        first,
        edges,
        measured,
        np.full((len(edges), 3), 4.0),
        INTRINSICS,
        NO_LINKS,
        2,
        8,
    )

    assert (poses[0] == truth[0]).all()
    for found, T in zip(poses[1:], truth[1:], strict=True):
        assert np.linalg.norm((inverse(T) @ found)[:3, 3]) < 0.006
    miss_m, start_m = (np.linalg.norm(p - points, axis=1).mean() for p in (refined, start_points))
    assert miss_m < 0.5 * start_m  # half a pixel of disparity noise leaves 2 cm at 2 m
    assert not agree[wrong].any()
    assert agree.mean() > 0.9


def test_bundle_of_exact_measurements_stays_where_it_is():
    rng = np.random.default_rng(5)
    truth, points, first, edges, measured = bundle(rng, noise_px=0.0)
    free = np.array([-1, 0, 1, 2, 3], np.int32)
    poses, refined, agree = adjust(
        truth, free, points, first, edges, measured, np.ones((len(edges), 3)), INTRINSICS, NO_LINKS, 2, 5
    )
    assert np.allclose(poses, truth, atol=1e-9)
    assert np.allclose(refined, points, atol=1e-9)
    assert agree.all()


def test_a_measured_relative_pose_holds_a_camera_that_points_hardly_do():
    """The last of five cameras sees two points only; it and its neighbour are linked, both free."""
    rng = np.random.default_rng(3)
    truth, points, first, edges, measured = bundle(rng, noise_px=0.1)
    weights = np.full((len(edges), 3), 4.0)
    weights[(edges[:, 0] == 4) & (edges[:, 1] > 1)] = 1e-12
    start = truth.copy()
    start[4] = random_pose(rng, translation_m=0.03, rotation_rad=0.02) @ truth[4]
    free = np.array([-1, 0, 1, 2, 3], np.int32)
    for pair in ((3, 4), (4, 3)):
        T_to_from = truth[pair[1]] @ inverse(truth[pair[0]])
        links = np.array([pair], np.int32), T_to_from[None], 1e8 * np.eye(6)[None]
        held, _, _ = adjust(start, free, points, first, edges, measured, weights, INTRINSICS, links, 2, 12)
        left, _, _ = adjust(start, free, points, first, edges, measured, weights, INTRINSICS, NO_LINKS, 2, 12)
        assert np.linalg.norm((inverse(truth[4]) @ held[4])[:3, 3]) < 0.002
        assert np.linalg.norm((inverse(truth[4]) @ left[4])[:3, 3]) > 0.005
