"""One point per voxel, the first that fell into it."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.frames import Points32

_EMPTY = -1


def thin(points: Points32, voxel_m: float) -> NDArray[np.intp]:
    """Return the indices of the first point in every voxel, ascending.

    Unlike a mean, a point that is kept has a time and a range of its own.

    Args:
        points: (N, 3) finite, metres.
        voxel_m: Edge of a voxel.
    """
    size = 1 << max(4, int(2 * len(points)).bit_length())
    kept: NDArray[np.intp] = _first_of_each(points, 1.0 / voxel_m, size)
    return kept


@njit(cache=True, nogil=True)
def _first_of_each(points, voxels_per_m, size):  # type: ignore[no-untyped-def]
    slots = np.full(size, _EMPTY, np.int64)
    cells = np.empty((len(points), 3), np.int64)
    kept = np.empty(len(points), np.int64)
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
            kept[count] = index
            count += 1
    return kept[:count].copy()
