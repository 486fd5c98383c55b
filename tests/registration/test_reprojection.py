"""Measurements of features as the refinement of a pose takes them."""

import numpy as np

from mapper.registration.reprojection import (
    VIRTUAL_BASELINE_PX_M,
    disparity_sigmas_px,
    image_measurements,
    residual,
)

INTRINSICS = np.array([520.0, 530.0, 320.0, 240.0])


def test_measurements_of_a_point_leave_no_residual():
    point = np.array([0.4, -0.2, 2.5])
    pixels = point[:2] / point[2] * INTRINSICS[:2] + INTRINSICS[2:]
    measured, weights, intrinsics = image_measurements(
        pixels[None],
        point[2:],
        INTRINSICS,
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
