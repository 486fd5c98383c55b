"""Points by voxels: the first that fell into each, or the mean of all."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Points

_EMPTY = -1


def thin(points: Points32, voxel_m: float) -> NDArray[np.intp]:
    """Return the indices of the first point in every voxel, ascending.

    Unlike a mean, a point that is kept has a time and a range of its own.

    Args:
        points: (N, 3) finite, metres.
        voxel_m: Edge of a voxel.
    """
    firsts: NDArray[np.intp] = _voxels(points, 1.0 / voxel_m, _table_size(points))[1]
    return firsts


def voxel_means(points: Points | Points32, voxel_m: float) -> Points:
    """Return (M, 3) float64 means of the points in every voxel, in the order of each voxel's first point.

    Args:
        points: (N, 3) finite, metres.
        voxel_m: Edge of a voxel.
    """
    voxel_of, firsts = _voxels(points, 1.0 / voxel_m, _table_size(points))
    means: Points = _means(points, voxel_of, len(firsts))
    return means


def _table_size(points: Points | Points32) -> int:
    return 1 << max(4, int(2 * len(points)).bit_length())


@njit(cache=True, nogil=True)
def _voxels(points, voxels_per_m, size):  # type: ignore[no-untyped-def]
    """Return (N,) each point's voxel, numbered as they are met, and (M,) the first point of each."""
    slots = np.full(size, _EMPTY, np.int64)
    cells = np.empty((len(points), 3), np.int64)
    voxel_of, firsts = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    count = 0
    for index in range(len(points)):
        x = np.int64(np.floor(points[index, 0] * voxels_per_m))
        y = np.int64(np.floor(points[index, 1] * voxels_per_m))
        z = np.int64(np.floor(points[index, 2] * voxels_per_m))
        slot = ((x * 73856093) ^ (y * 19349669) ^ (z * 83492791)) & (size - 1)
        while slots[slot] != _EMPTY:
            other = slots[slot]
            if cells[other, 0] == x and cells[other, 1] == y and cells[other, 2] == z:
                break
            slot = (slot + 1) & (size - 1)
        if slots[slot] == _EMPTY:
            slots[slot] = count
            cells[count] = (x, y, z)
            firsts[count] = index
            count += 1
        voxel_of[index] = slots[slot]
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
