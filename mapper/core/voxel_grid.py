"""Voxel grid downsampling: the first point in every voxel, or the mean of its points."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Points
from mapper.core.voxel_index import cell_key, claim_row, voxel_index

DIAGONAL = math.sqrt(3.0)
"""Largest distance of the centres of voxels that share a corner, in edges."""


def thin(points: Points32, voxel_m: float) -> NDArray[np.intp]:
    """Return the indices of the first point in every voxel, ascending.

    Unlike a mean, a point that is kept has its own time and range.

    Args:
        points: (N, 3) finite, metres.
        voxel_m: Edge of a voxel.
    """
    firsts: NDArray[np.intp] = _voxels(points, 1.0 / voxel_m, voxel_index(len(points)))[1]
    return firsts


def voxel_means(points: Points | Points32, voxel_m: float) -> Points:
    """Return (M, 3) float64 means of the points in every voxel, in the order of each voxel's first point.

    Args:
        points: (N, 3) finite, metres.
        voxel_m: Edge of a voxel.
    """
    voxel_of, firsts = _voxels(points, 1.0 / voxel_m, voxel_index(len(points)))
    means: Points = _means(points, voxel_of, len(firsts))
    return means


@njit(cache=True, nogil=True)
def _voxels(points, voxels_per_m, index):  # type: ignore[no-untyped-def]
    """Return (N,) each point's voxel, numbered in order of first points, and (M,) those first points."""
    voxel_of, firsts = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    count = 0
    for i in range(len(points)):
        key = cell_key(points[i, 0] * voxels_per_m, points[i, 1] * voxels_per_m, points[i, 2] * voxels_per_m)
        voxel = claim_row(index, key, count)
        if voxel == count:
            firsts[count] = i
            count += 1
        voxel_of[i] = voxel
    return voxel_of, firsts[:count].copy()


@njit(cache=True, nogil=True)
def _means(points, voxel_of, count):  # type: ignore[no-untyped-def]
    sums, counts = np.zeros((count, 3)), np.zeros(count)
    for index in range(len(points)):
        voxel = voxel_of[index]
        for k in range(3):
            sums[voxel, k] += points[index, k]
        counts[voxel] += 1.0
    for voxel in range(count):
        for k in range(3):
            sums[voxel, k] /= counts[voxel]
    return sums
