import numpy as np
import pytest

from mapper.core.geometry import apply, exp, log
from mapper.registration.reprojection import normal_matrix, refine_pose
from mapper.registration.variance_factor import disparity_variance_ratio, residual_statistics

INTRINSICS = np.array([525.0, 525.0, 319.5, 239.5, 40.0])


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
    return plain, plain / residual_statistics(*seen).variance_factor


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
    assert (
        residual_statistics(
            exp(np.zeros(3), np.zeros(3)), point, measured, np.ones((1, 3)), INTRINSICS
        ).variance_factor
        == 1.0
    )


def test_points_found_with_the_measurements_leave_less_of_the_error_in_residuals():
    """Points are the mean of two images, so a half of each error's variance is in a residual."""
    rng = np.random.default_rng(6)
    pixels, z = rng.uniform([20, 20], [620, 460], (400, 2)), rng.uniform(1.0, 3.0, 400)
    seen = np.column_stack([pixels, INTRINSICS[4] / z])[None] + rng.normal(0.0, 0.7, (2, 400, 3))
    u, v, disparity = seen.mean(axis=0).T
    points = np.column_stack([(u - 319.5) / 525.0, (v - 239.5) / 525.0, np.ones(400)])
    points *= INTRINSICS[4] / disparity[:, None]
    known = np.eye(4), points, seen[0], np.ones((400, 3)), INTRINSICS
    shares = np.full(400, 0.5)
    assert residual_statistics(*known).variance == pytest.approx(0.5 * 0.7**2, rel=0.1)
    assert residual_statistics(*known, redundancy=shares).variance == pytest.approx(0.7**2, rel=0.1)


def disparity_ratio(*, disparity_px: float, shared_px: float) -> float:
    """Return the median ratio of 200 poses whose pixels err by 0.4 of their standard deviations."""
    rng, ratios = np.random.default_rng(7), []
    for _ in range(200):
        pixels, z = rng.uniform([20, 20], [620, 460], (400, 2)), rng.uniform(1.0, 5.0, 400)
        points = np.column_stack([(pixels - INTRINSICS[2:4]) / INTRINSICS[:2] * z[:, None], z])
        sigma_px = 1.2 ** rng.integers(0, 4, 400)
        scatter = rng.normal(0.0, [0.4, 0.4, disparity_px], (400, 3)) * sigma_px[:, np.newaxis]
        measured = np.column_stack([pixels, INTRINSICS[4] / z]) + scatter
        measured[:, 2] += shared_px * np.sin(0.01 * pixels[:, 0] + rng.uniform(0.0, 6.3))
        ratios.append(disparity_variance_ratio(np.eye(4), points, measured, sigma_px, INTRINSICS))
    return float(np.median(ratios))


def test_disparities_are_compared_with_pixels():
    assert disparity_ratio(disparity_px=0.4, shared_px=0.0) == pytest.approx(1.0, rel=0.2)
    assert disparity_ratio(disparity_px=0.1, shared_px=0.0) == pytest.approx(1.0 / 16.0, rel=0.2)


def test_distortion_of_depth_counts_more_than_scatter_of_the_same_size():
    assert disparity_ratio(disparity_px=0.1, shared_px=0.14) > 5.0 * disparity_ratio(
        disparity_px=0.14, shared_px=0.0
    )


def test_exact_measurements_have_a_ratio():
    pixels, z = np.array([[100.0, 80.0], [400.0, 300.0]]), np.array([2.0, 3.0])
    points = np.column_stack([(pixels - INTRINSICS[2:4]) / INTRINSICS[:2] * z[:, None], z])
    measured = np.column_stack([pixels, INTRINSICS[4] / z])
    assert np.isfinite(disparity_variance_ratio(np.eye(4), points, measured, np.ones(2), INTRINSICS))
