"""Measured points of a cloud, found and copied in one pass over its bytes."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.frames import Points32


def measured(points: NDArray[np.float32], *, farthest_m: float) -> tuple[Points32, NDArray[np.intp] | None]:
    """Return (M, 3) points that are finite, not at the origin, and near enough, and which those are.

    Args:
        points: (N, 3) with any strides, metres.
        farthest_m: Distance from which on a point is taken for damage, metres.

    Returns:
        Their coordinates, and (M,) rows; None where that is all of them.
    """
    kept_points = np.empty((len(points), 3), np.float32)
    rows = np.empty(len(points), np.intp)
    count = _gather(points, np.float32(farthest_m**2), kept_points, rows)
    if count == len(points):
        return kept_points, None
    return kept_points[:count].copy(), rows[:count]


@njit(cache=True, nogil=True)
def _gather(points, farthest_m2, kept_points, rows):  # type: ignore[no-untyped-def]
    """Copy what was measured to the front, and return how much that is; NaN compares false."""
    count = 0
    for row in range(len(points)):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        squared_m2 = x * x + y * y + z * z
        if np.float32(0.0) < squared_m2 < farthest_m2:
            kept_points[count, 0] = x
            kept_points[count, 1] = y
            kept_points[count, 2] = z
            rows[count] = row
            count += 1
    return count
