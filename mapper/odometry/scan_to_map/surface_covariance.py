"""Covariance of a scan on a keyframe's surfaces, from its distances to them."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array

_SECTORS = 12  # of azimuth, each of two elevations
_FEWEST = 10  # points of a sector that shows how much its distances agree
_MEDIAN_CHI2, _FREEDOM = 0.455, 6.0  # of one degree of freedom; of a pose
_LEAST_SHARE, _LEAST_SCATTER = 1e-9, 1e-2  # relative to the best known motion; to independent distances
_SCATTER = 0.75
"""Weight of the scatter in the mean: with a half, one second in a bare field was 0.3 m and 6 sigma off."""


def surface_covariance(rows: Array, residuals_m: Array, points: Array) -> Array:
    """Return the (6, 6) covariance of the scan's tangent from its distances to the keyframe's surfaces.

    Distances of neighbouring points share the errors of one normal, of the map and of the sensor. Two
    estimates allow for that: the one of independent distances, σ²H⁻¹, times their design effect (Kish 1965,
    §5.4), one number for all motions, and the scatter of the steps of 24 sectors (Liang & Zeger 1986, eq. 8),
    a matrix. The first is blind to motions that few sectors show; the second takes for errors of the pose
    what a map of many keyframes averages. Theirs is the geometric mean, weighted 1 : 3.

    To it comes the square of the step that would fit the scan to this keyframe best, as far as it exceeds
    what the scatter explains: a matcher that is biased, or a map that disagrees with the keyframe, is off by
    as much.

    Args:
        rows: (M, 6) Jacobian of the distances by the scan's tangent.
        residuals_m: (M,) distances of the scan's points from the keyframe's surfaces.
        points: (M, 3) these points, scan's frame.
    """
    hessian = np.einsum("ni,nj->ij", rows, rows)
    scale = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
    known, motions = np.linalg.eigh(hessian / np.outer(scale, scale))
    sigmas = np.maximum(known, _LEAST_SHARE * known[-1]) ** -0.5
    sectors = _sectors(points)
    counts = np.bincount(sectors)
    variance = float(np.mean(residuals_m**2)) * _design_effect(residuals_m, sectors, counts)
    if variance == 0.0:
        return np.zeros((6, 6))
    columns = (rows / scale) @ (motions * (sigmas / np.sqrt(variance)))
    steps: Array = np.stack([np.bincount(sectors, column * residuals_m) for column in columns.T], axis=1)
    used = int((counts > 0).sum())
    scatter, axes = np.linalg.eigh(np.einsum("ci,cj->ij", steps, steps) * (used / max(used - 6, 1)))
    scatter = np.maximum(scatter, _LEAST_SCATTER)
    step = steps.sum(axis=0) @ axes
    chi2 = float(np.sum(step**2 / scatter))
    unexplained = max(0.0, 1.0 - _FREEDOM / chi2) if chi2 > 0.0 else 0.0
    to_tangent = (motions * (sigmas * np.sqrt(variance))) @ axes / scale[:, None]
    along_axes = to_tangent @ (np.diag(scatter**_SCATTER) + unexplained * np.outer(step, step))
    return np.asarray(along_axes @ to_tangent.T, np.float64)


def _design_effect(residuals_m: Array, sectors: NDArray[np.intp], points: NDArray[np.intp]) -> float:
    """Return how many times the variance exceeds that of independent distances; 1 with too few points."""
    sums, squares = (np.bincount(sectors, weights) for weights in (residuals_m, residuals_m**2))
    enough = (points >= _FEWEST) & (squares > 0.0)
    if not enough.any():
        return 1.0
    return max(1.0, float(np.median(sums[enough] ** 2 / squares[enough])) / _MEDIAN_CHI2)


def _sectors(points: Array) -> NDArray[np.intp]:
    """Return the number of each point's sector about the sensor."""
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    around = np.minimum(((azimuth + np.pi) * (_SECTORS / (2.0 * np.pi))).astype(np.intp), _SECTORS - 1)
    return 2 * around + (points[:, 2] > np.median(points[:, 2]))
