"""Camera poses by least reprojection error: what they are measured from, and how sure they are."""

import numpy as np
import pytest

from mapper.core.geometry import apply, exp, log
from mapper.registration.reprojection import (
    VIRTUAL_BASELINE_PX_M,
    disparity_sigmas_px,
    image_measurements,
    normal_matrix,
    refine_pose,
    residual,
    variance_factor,
)

INTRINSICS = np.array([525.0, 525.0, 319.5, 239.5, 40.0])


def test_measurements_of_a_point_leave_no_residual():
    point = np.array([0.4, -0.2, 2.5])
    pixels = point[:2] / point[2] * INTRINSICS[:2] + INTRINSICS[2:4]
    measured, weights, intrinsics = image_measurements(
        pixels[None],
        point[2:],
        INTRINSICS[:4],
        sigma_px=np.array([2.0]),
        disparity_sigma_px=np.array([0.5]),
    )
    left = np.empty(3)
    residual(np.eye(4), point, measured[0], intrinsics, left)
    np.testing.assert_allclose(left, 0.0, atol=1e-12)
    np.testing.assert_allclose(weights, [[0.25, 0.25, 4.0]])


def test_sigmas_of_disparities_are_those_of_depths_by_the_slope():
    depth_m, sigma_m = np.array([0.5, 2.0, np.nan]), np.array([1e-4, 1e-3, np.nan])
    changed = VIRTUAL_BASELINE_PX_M / depth_m - VIRTUAL_BASELINE_PX_M / (depth_m + sigma_m)
    np.testing.assert_allclose(disparity_sigmas_px(depth_m, sigma_m), [*changed[:2], 1.0], rtol=1e-3)


def nees(rng: np.random.Generator, *, sigma_px: float, shared_px: float, n: int = 200) -> tuple[float, float]:
    """Return χ²/6 of a pose's error by its normal matrix as it is, and divided by the factor.

    Args:
        rng: Source of the scene and the errors.
        sigma_px: Error of each feature; the weights say 1 px.
        shared_px: Error that neighbours share: a smooth field over the image.
        n: Number of features.
    """
    pixels, z = rng.uniform([20, 20], [620, 460], (n, 2)), rng.uniform(1.0, 3.0, n)
    points = np.column_stack([(pixels - INTRINSICS[2:4]) / INTRINSICS[:2] * z[:, None], z])
    phase = pixels @ rng.uniform(-0.02, 0.02, (2, 3)) + rng.uniform(0.0, 6.3, 3)
    measured = np.column_stack([pixels, INTRINSICS[4] / z])
    measured += rng.normal(0.0, sigma_px, (n, 3)) + 1.4 * shared_px * np.sin(phase)
    weights = np.ones((n, 3))
    T, agree, _ = refine_pose(np.eye(4), points, measured, weights, INTRINSICS, 3, 10)
    seen = T, points[agree], measured[agree], weights[agree], INTRINSICS
    twist = np.concatenate(log(T))
    plain = float(twist @ normal_matrix(*seen) @ twist) / 6.0
    return plain, plain / variance_factor(*seen)


def averages(**errors: float) -> tuple[float, float]:
    rng = np.random.default_rng(5)
    plain, honest = np.mean([nees(rng, **errors) for _ in range(60)], axis=0)
    return float(plain), float(honest)


@pytest.mark.parametrize("sigma_px", [0.3, 1.0])
def test_independent_errors_are_as_large_as_their_residuals(sigma_px):
    plain, honest = averages(sigma_px=sigma_px, shared_px=0.0)
    assert plain == pytest.approx(sigma_px**2, rel=0.25)
    assert 0.6 < honest < 1.3


def test_errors_that_neighbours_share_count_for_more():
    plain, honest = averages(sigma_px=0.4, shared_px=0.8)
    assert plain > 4.0
    assert honest < 0.5 * plain


def test_too_few_features_are_taken_as_they_are():
    point = np.array([[0.1, 0.0, 2.0]])
    measured = np.column_stack([apply(np.eye(4), point)[:, :2] / 2.0 * 525.0 + 300.0, [[20.0]]])
    assert variance_factor(exp(np.zeros(3), np.zeros(3)), point, measured, np.ones((1, 3)), INTRINSICS) == 1.0
