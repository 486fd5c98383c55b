"""Filter of missing and damaged returns of a point cloud, compiled: one pass over its bytes."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.frames import Points32


def valid_returns(
    points: NDArray[np.float32], *, farthest_m: float
) -> tuple[Points32, NDArray[np.intp] | None]:
    """Return the points that are finite, not at the origin, and nearer than a limit, and their rows.

    Args:
        points: (N, 3) with any strides, metres.
        farthest_m: Limit of the distance from the origin.

    Returns:
        (M, 3) coordinates, and (M,) rows; None for the rows where all points are valid.
    """
    kept_points = np.empty((len(points), 3), np.float32)
    rows = np.empty(len(points), np.intp)
    count = _gather(points, np.float32(farthest_m**2), kept_points, rows)
    if count == len(points):
        return kept_points, None
    return kept_points[:count].copy(), rows[:count]


@njit(cache=True, nogil=True)
def _gather(points, farthest_m2, kept_points, rows):  # type: ignore[no-untyped-def]
    """Copy the valid points to the front and return their number; NaN compares false."""
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
