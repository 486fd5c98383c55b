"""Points among features that move by themselves: the rest of a body that some features show to move."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Points

_NEAR_M = 0.3
"""Distance within which points are of one body: half the width of a person, and more than their features are
apart."""
_NEIGHBOURS = 5
"""Nearest features that are counted, so that a mismatch on a wall is outvoted by those at rest around it."""


def among_moving(
    points: Points, features: Points, is_moving: NDArray[np.bool_], is_still: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return (N,) which points have more moving than still features among the nearest.

    Args:
        points: (N, 3) metres, NaN without depth: these are among none.
        features: (M, 3) metres in the same axes, NaN without depth.
        is_moving: (M,) features that are known to move.
        is_still: (M,) features that are known to be at rest.
    """
    known = np.flatnonzero((is_moving | is_still) & ~np.isnan(features[:, 2]))
    found: NDArray[np.bool_] = _majority(points, features[known], is_moving[known])
    return found


@njit(cache=True, nogil=True)
def _majority(points, known, is_moving):  # type: ignore[no-untyped-def]
    """Return (N,) for which points more of the nearest known ones move than not."""
    found = np.zeros(len(points), np.bool_)
    squares, moves = np.empty(_NEIGHBOURS), np.empty(_NEIGHBOURS, np.bool_)
    for n in range(len(points)):
        if np.isnan(points[n, 2]):
            continue
        count = 0
        for k in range(len(known)):
            dx, dy = points[n, 0] - known[k, 0], points[n, 1] - known[k, 1]
            dz = points[n, 2] - known[k, 2]
            square = dx * dx + dy * dy + dz * dz
            if square > _NEAR_M**2 or (count == _NEIGHBOURS and square >= squares[-1]):
                continue
            at = min(count, _NEIGHBOURS - 1)
            while at > 0 and squares[at - 1] > square:
                squares[at], moves[at] = squares[at - 1], moves[at - 1]
                at -= 1
            squares[at], moves[at] = square, is_moving[k]
            count = min(count + 1, _NEIGHBOURS)
        found[n] = 2 * moves[:count].sum() > count
    return found
