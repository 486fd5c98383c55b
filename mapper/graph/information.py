"""Information matrices of many edges at once, from the upper triangles that g2o text holds."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array

# g2o orders a pose's tangent (translation, rotation); ours is (rotation, translation).
_SWAPPED = np.array([3, 4, 5, 0, 1, 2])
_PLANAR = np.array([3, 4, 2])
"""Indices of x, y and yaw in the tangent."""


def swapped(information: Array) -> Array:
    """Return (N, 6, 6) matrices from g2o's order of the tangent in ours, or back."""
    return information[:, _SWAPPED][:, :, _SWAPPED]


def symmetric(upper: Array, rows: int) -> Array:
    """Return (N, rows, rows) symmetric matrices of their upper triangles, row by row."""
    where = np.triu_indices(rows)
    matrices = np.zeros((len(upper), rows, rows))
    matrices[:, *where] = upper
    matrices[:, *where[::-1]] = upper
    return matrices


def lifted(planar: Array) -> Array:
    """Return (N, 6, 6) of (N, 3, 3) over (x, y, yaw): the other motions get an edge's largest information."""
    largest = planar.diagonal(axis1=1, axis2=2).max(axis=1)
    information: Array = largest[:, np.newaxis, np.newaxis] * np.eye(6)
    information[:, _PLANAR[:, np.newaxis], _PLANAR] = planar
    return information


def as_gtsam_takes(information: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return positive definite matrices in place of indefinite ones, and which were.

    GTSAM weighs residuals with the Cholesky factor R of the information, information = RᵀR. Eigen's LLT
    stops at the first pivot that is not positive and leaves the rest of R as the matrix had it;
    costs published for such graphs rest on that R.

    Args:
        information: (N, k, k) symmetric, with positive diagonals, in GTSAM's order.
    """
    factor = np.tril(information)
    positive = np.ones(len(factor), dtype=np.bool_)
    for k in range(factor.shape[1]):
        done = factor[:, k, :k]
        pivot = factor[:, k, k] - (done * done).sum(axis=1)
        positive &= pivot > 0.0
        root = np.sqrt(pivot[positive])
        below = factor[positive, k + 1 :, k] - np.einsum(
            "nij,nj->ni", factor[positive, k + 1 :, :k], done[positive]
        )
        factor[positive, k, k] = root
        factor[positive, k + 1 :, k] = below / root[:, np.newaxis]
    taken = information.copy()
    taken[~positive] = factor[~positive] @ np.swapaxes(factor[~positive], 1, 2)
    return taken, ~positive
