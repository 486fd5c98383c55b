"""Variance factor of a pose from features: how far residuals are from independent ones of known size."""

from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array, Points, Transform
from mapper.registration.reprojection import normal_matrix, scores

_COLUMNS, _ROWS = 4, 3
"""Cells of the image; features of one cell share the errors of lens, depth and shutter."""


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """Size and dependence of a pose's residuals.

    Attributes:
        variance: Their mean square in standard deviations: features may be found better or worse than their
            weights say.
        design_effect: By how much residuals that agree within a cell of the image carry less information than
            independent ones (Kish 1965, §5.4); about 1 if they are independent.
    """

    variance: float
    design_effect: float

    @property
    def variance_factor(self) -> float:
        """By how much the inverse of the normal matrix has to be multiplied to be the covariance."""
        return max(1.0, self.design_effect) * self.variance


def residual_statistics(
    T_camera_world: Transform, points: Points, measured: Array, weights: Array, intrinsics: Array
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
    """
    gradients, squares = scores(T_camera_world, points, measured, weights, intrinsics)
    freedom = int(np.isfinite(measured).sum()) - 6
    if freedom <= 0:
        return ResidualStatistics(1.0, 1.0)
    variance = float(squares.sum()) / freedom
    share = measured[:, :2] / (2.0 * intrinsics[2:4])
    cell = np.clip((share * [_COLUMNS, _ROWS]).astype(np.intp), 0, [_COLUMNS - 1, _ROWS - 1])
    cells, cell_of = np.unique(cell @ [1, _COLUMNS], return_inverse=True)
    if len(cells) < 2:
        return ResidualStatistics(variance, 1.0)
    sums = np.zeros((len(cells), 6))
    np.add.at(sums, cell_of, gradients)
    covariance = np.linalg.inv(normal_matrix(T_camera_world, points, measured, weights, intrinsics))
    together, alone = (float(np.einsum("na,ab,nb->", g, covariance, g)) for g in (sums, gradients))
    return ResidualStatistics(variance, together * len(cells) / (len(cells) - 1) / alone)
