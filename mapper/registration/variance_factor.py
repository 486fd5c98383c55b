"""Variance factor of a pose from features: how far residuals are from independent ones of known size."""

import numpy as np

from mapper.core.geometry import Array, Points, Transform
from mapper.registration.reprojection import normal_matrix, scores

_COLUMNS, _ROWS = 4, 3
"""Cells of the image; features of one cell share the errors of lens, depth and shutter."""


def variance_factor(
    T_camera_world: Transform, points: Points, measured: Array, weights: Array, intrinsics: Array
) -> float:
    """Return by how much the inverse of a pose's normal matrix has to be multiplied to be its covariance.

    One factor is the residuals' own variance: features may be found better or worse than their weights say.
    The other is the design effect (Kish 1965, §5.4): residuals that agree within a cell of the image carry
    less information than independent ones, by the cluster-robust covariance of the scores (Liang & Zeger
    1986, eq. 8) relative to that of independent ones. It is one number for all directions, as so few cells
    do not determine a matrix.

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
        return 1.0
    share = measured[:, :2] / (2.0 * intrinsics[2:4])
    cell = np.clip((share * [_COLUMNS, _ROWS]).astype(np.intp), 0, [_COLUMNS - 1, _ROWS - 1])
    cells, cell_of = np.unique(cell @ [1, _COLUMNS], return_inverse=True)
    if len(cells) < 2:
        return float(squares.sum()) / freedom
    sums = np.zeros((len(cells), 6))
    np.add.at(sums, cell_of, gradients)
    covariance = np.linalg.inv(normal_matrix(T_camera_world, points, measured, weights, intrinsics))
    together, alone = (float(np.einsum("na,ab,nb->", g, covariance, g)) for g in (sums, gradients))
    design_effect = together * len(cells) / (len(cells) - 1) / alone
    return max(1.0, design_effect) * float(squares.sum()) / freedom
