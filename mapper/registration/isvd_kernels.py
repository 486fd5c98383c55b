"""ISVD's iterations (Somlyai, PhD thesis, alg. 7), compiled."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points


@njit(cache=True, nogil=True)
def trim(
    target: Points, source: Points, thresholds_m: Array, min_error_m: float, enough: int
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Fit a motion to pairs, drop those beyond the iteration's threshold, and fit again.

    Args:
        target: (N, 3) points, metres, N ≥ 3.
        source: (N, 3) their partners.
        thresholds_m: (M,) largest distance of a pair in each iteration, M ≥ 1.
        min_error_m: The iteration whose threshold falls below this is the last.
        enough: So is one that would leave fewer pairs than this.

    Returns:
        (3, 3) rotation and (3,) translation of the last iteration, and the indices of the pairs they were
        fitted to.
    """
    R, t = np.eye(3), np.zeros(3)
    used = np.arange(len(target))
    kept = used
    for threshold_m in thresholds_m:
        used = kept
        R, t = _fit(target, source, used)
        kept = used.copy()
        count = 0
        for i in used:
            squared = 0.0
            for k in range(3):
                miss = target[i, k] - t[k]
                for m in range(3):
                    miss -= R[k, m] * source[i, m]
                squared += miss * miss
            if squared <= threshold_m * threshold_m:
                kept[count] = i
                count += 1
        kept = kept[:count]
        if threshold_m < min_error_m or count < enough:
            break
    return R, t, used


@njit(cache=True, nogil=True)
def _fit(target: Points, source: Points, used: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return the rotation and translation of the used pairs, as ``core.geometry.fit_rigid`` does."""
    target_mean, source_mean = np.zeros(3), np.zeros(3)
    for i in used:
        for k in range(3):
            target_mean[k] += target[i, k]
            source_mean[k] += source[i, k]
    target_mean /= len(used)
    source_mean /= len(used)
    covariance = np.zeros((3, 3))
    for i in used:
        for k in range(3):
            for m in range(3):
                covariance[k, m] += (target[i, k] - target_mean[k]) * (source[i, m] - source_mean[m])
    U, _, Vt = np.linalg.svd(covariance)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0.0:
        U[:, 2] = -U[:, 2]
    R = U @ Vt
    return R, target_mean - R @ source_mean
