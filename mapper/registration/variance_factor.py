"""Variance factor of a pose from features: how far residuals are from independent ones of known size."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform, apply
from mapper.registration.reprojection import normal_matrix, scores

_COLUMNS, _ROWS = 4, 3
"""Cells of the image; features of one cell share the errors of lens, depth and shutter."""


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """Size and dependence of a pose's residuals.

    Attributes:
        variance: Their mean square in standard deviations: features may be found better or worse than their
            weights say.
        design_effect: Factor by which residuals that agree within a cell of the image carry less information
            than independent ones (Kish 1965, §5.4); about 1 if they are independent.
        cell_scores: (12, 6) sums of the residuals' gradients in each cell, whitened, relative to what
            independent ones amount to: their squares add up to about the design effect. None of too few
            residuals.
    """

    variance: float
    design_effect: float
    cell_scores: Array | None = field(default=None, repr=False, compare=False)

    @property
    def variance_factor(self) -> float:
        """Factor on the inverse of the normal matrix that makes it the covariance."""
        return max(1.0, self.design_effect) * self.variance


def residual_statistics(
    T_camera_world: Transform,
    points: Points,
    measured: Array,
    weights: Array,
    intrinsics: Array,
    *,
    redundancy: Array | None = None,
) -> ResidualStatistics:
    """Return the statistics of a pose's residuals.

    The design effect is the cluster-robust covariance of the scores (Liang & Zeger 1986, eq. 8) relative to
    that of independent ones: one number for all directions, as so few cells do not determine a matrix.

    Args:
        T_camera_world: (4, 4) at the least squares.
        points: (N, 3) metres, world; inliers only.
        measured: (N, 3) u, v, bf/z in pixels; NaN in the third column without depth.
        weights: (N, 3) inverse variances of the three, px⁻².
        intrinsics: (5,) fx, fy, cx, cy, bf.
        redundancy: (N,) share of its own error that a measurement leaves in its residual (Baarda 1968): less
            than 1 where it took part in finding the point. None for points found without these measurements.
    """
    gradients, squares = scores(T_camera_world, points, measured, weights, intrinsics)
    counted = np.isfinite(measured).sum(axis=1)
    freedom = float(counted.sum() if redundancy is None else redundancy @ counted) - 6.0
    if freedom <= 0.0:
        return ResidualStatistics(1.0, 1.0)
    variance = float(squares.sum()) / freedom
    cells, cell_of = np.unique(_cells(measured, intrinsics), return_inverse=True)
    if len(cells) < 2:
        return ResidualStatistics(variance, 1.0)
    sums = np.zeros((len(cells), 6))
    np.add.at(sums, cell_of, gradients)
    covariance = np.linalg.inv(normal_matrix(T_camera_world, points, measured, weights, intrinsics))
    together, alone = (float(np.einsum("na,ab,nb->", g, covariance, g)) for g in (sums, gradients))
    scores_of_cells = np.zeros((_COLUMNS * _ROWS, 6))
    scores_of_cells[cells] = sums @ np.linalg.cholesky(0.5 * (covariance + covariance.T)) / np.sqrt(alone)
    return ResidualStatistics(variance, together * len(cells) / (len(cells) - 1) / alone, scores_of_cells)


def disparity_variance_ratio(
    T_camera_world: Transform, points: Points, measured: Array, sigma_px: Array, intrinsics: Array
) -> float:
    """Return the variance of disparities relative to that of pixels, by a pose's residuals.

    A component of variance (Helmert 1907) of each, from the sums of residuals within cells of the image
    (Liang & Zeger 1986, eq. 8): errors that neighbours share, as distortion of depth is, count for more.

    Args:
        T_camera_world: (4, 4) at the least squares.
        points: (N, 3) metres, world; inliers only.
        measured: (N, 3) u, v, bf/z in pixels.
        sigma_px: (N,) standard deviations of the features' pixels.
        intrinsics: (5,) fx, fy, cx, cy, bf.
    """
    points_camera = apply(T_camera_world, points)
    z = points_camera[:, 2:]
    pixels = points_camera[:, :2] / z * intrinsics[:2] + intrinsics[2:4]
    residuals = (measured - np.column_stack([pixels, intrinsics[4] / z])) / sigma_px[:, np.newaxis]
    sums = np.zeros((_COLUMNS * _ROWS, 3))
    np.add.at(sums, _cells(measured, intrinsics), residuals)
    u, v, disparity = (sums**2).sum(axis=0)
    return float(2.0 * disparity / max(u + v, 1e-12))


def _cells(measured: Array, intrinsics: Array) -> NDArray[np.intp]:
    """Return the (N,) number of the cell of the image in which each pixel lies."""
    share = measured[:, :2] / (2.0 * intrinsics[2:4])
    cell = np.clip((share * [_COLUMNS, _ROWS]).astype(np.intp), 0, [_COLUMNS - 1, _ROWS - 1])
    return cell[:, 0] + _COLUMNS * cell[:, 1]
