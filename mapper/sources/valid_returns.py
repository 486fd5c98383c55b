"""Filter of missing and damaged returns of a scan, compiled: one pass over its bytes."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.frames import Points32

FARTHEST_M = 5000.0
"""Distance from the sensor that no LiDAR on a vehicle reaches: a return beyond it is damage. The keys of an
octree reach 6553.6 m from the map's origin at the default 0.2 m, and one return beyond has no place in it."""


class ValidReturns(NamedTuple):
    """Returns of a scan that can be used.

    Attributes:
        points: (M, 3) float32 metres.
        rows: (M,) their rows; None where all are valid.
        far: Number of others that are finite, but farther than ``FARTHEST_M``.
    """

    points: Points32
    rows: NDArray[np.intp] | None
    far: int


def valid_returns(points: NDArray[np.float32]) -> ValidReturns:
    """Return the points that are finite, not at the origin, and not farther than any sensor reaches.

    Args:
        points: (N, 3) with any strides, metres, sensor frame.
    """
    kept_points = np.empty((len(points), 3), np.float32)
    rows = np.empty(len(points), np.intp)
    count, far = _gather(points, np.float32(FARTHEST_M**2), kept_points, rows)
    if count == len(points):
        return ValidReturns(kept_points, None, far)
    return ValidReturns(kept_points[:count].copy(), rows[:count], far)


@njit(cache=True, nogil=True)
def _gather(points, farthest_m2, kept_points, rows):
    """Copy the valid points to the front; return their number and that of the far; NaN compares false."""
    count, far = 0, 0
    for row in range(len(points)):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        squared_m2 = x * x + y * y + z * z
        if np.float32(0.0) < squared_m2 < farthest_m2:
            kept_points[count, 0] = x
            kept_points[count, 1] = y
            kept_points[count, 2] = z
            rows[count] = row
            count += 1
        elif squared_m2 >= farthest_m2 and np.isfinite(x) and np.isfinite(y) and np.isfinite(z):
            far += 1
    return count, far
