"""Exact Euclidean distance transforms, in integers (after Meijster, Roerdink & Hesselink 2000).

As in Felzenszwalb & Huttenlocher (2012) the lower envelope of parabolas is taken axis after axis, in linear
time; borders between parabolas are kept as the first whole cell, so nothing is rounded.
``scipy.ndimage.distance_transform_edt`` takes 4 to 5 times as long, and has distances to centres only.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import MapSizeError

Squares = NDArray[np.int32]
Line = NDArray[np.int64]

NONE = (1 << 31) - 1
"""Squared distance where there is no target at all."""

_MOST_CELLS = 13_000  # along an edge: three squares of twice as many still fit into an int32
_LINES = 16  # processed together: 16 int32 fill a cache line


def squares_to_centres(targets: NDArray[np.bool_]) -> Squares:
    """Return the squared distance of every cell's centre to that of the nearest target, in cells².

    Args:
        targets: (Z, Y, X); a plane is (1, H, W).

    Returns:
        (Z, Y, X) int32, 0 on targets; NONE everywhere if there is no target.

    Raises:
        MapSizeError: An edge is too long for the squares to fit into an int32.
    """
    return _squares(targets, solid=False)


def plane_distances(targets: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return (H, W) distance of every cell's centre to that of the nearest target of (H, W), in cells.

    It is +inf where there is no target. Errors as of ``squares_to_centres``.
    """
    squares = squares_to_centres(targets[np.newaxis])[0]
    return np.where(squares == NONE, np.inf, np.sqrt(squares))


def squares_to_boxes(targets: NDArray[np.bool_]) -> Squares:
    """Return the squared distance of every cell's centre to the nearest target's surface, in quarter cells².

    A target is its whole square or cube, and distances are counted in half cells, which keeps them integers.
    Everything else is as for :func:`squares_to_centres`.
    """
    return _squares(targets, solid=True)


def _squares(targets: NDArray[np.bool_], *, solid: bool) -> Squares:
    depth, height, width = targets.shape
    if max(targets.shape) > _MOST_CELLS:
        raise MapSizeError(
            f"distances in {depth}×{height}×{width} cells: an edge may have {_MOST_CELLS}; "
            "choose a smaller box or a coarser map"
        )
    squares = np.empty(targets.shape, np.int32)
    _along_rows(np.ascontiguousarray(targets), squares, solid)
    _across_rows(squares, solid)
    _across_rows(squares.reshape(1, depth, height * width), solid)
    return squares


@njit(cache=True, nogil=True)
def _along_rows(targets: NDArray[np.bool_], squares: Squares, solid: bool) -> None:
    """Write the squared distance to the nearest target of the same row."""
    depth, height, width = targets.shape
    for z in range(depth):
        for y in range(height):
            gap = width
            for x in range(width):
                gap = 0 if targets[z, y, x] else gap + 1
                squares[z, y, x] = gap
            found = gap < width
            gap = width
            for x in range(width - 1, -1, -1):
                gap = 0 if targets[z, y, x] else gap + 1
                nearest = min(gap, squares[z, y, x])
                if solid:
                    nearest = max(2 * nearest - 1, 0)
                squares[z, y, x] = nearest * nearest if found else NONE


@njit(cache=True, nogil=True)
def _across_rows(squares: Squares, solid: bool) -> None:
    """Replace every value of (A, N, M) by the minimum over i of squares[a, i, m] + distance(n, i)²."""
    count, length, width = squares.shape
    if length == 1:
        return
    lines, lowest = np.empty((_LINES, length), np.int64), np.empty(length, np.int64)
    heights = np.empty(length + 1, np.int64)
    owner, begin = np.empty(length + 1, np.int64), np.empty(length + 1, np.int64)
    for a in range(count):
        for left in range(0, width, _LINES):
            together = min(_LINES, width - left)
            for n in range(length):
                for k in range(together):
                    lines[k, n] = squares[a, n, left + k]
            for k in range(together):
                line = lines[k]
                if solid:
                    # A cell's two faces across this axis; neighbours share one. Between them the cell's own
                    # value holds, which is the lowest parabola's apex or less.
                    heights[0], heights[length] = line[0], line[length - 1]
                    for n in range(1, length):
                        heights[n] = min(line[n - 1], line[n])
                    _envelope(heights, 2, -1, lowest, owner, begin)
                    for n in range(length):
                        line[n] = min(line[n], lowest[n])
                else:
                    _envelope(line, 1, 0, lowest, owner, begin)
                    line[:] = lowest
            for n in range(length):
                for k in range(together):
                    squares[a, n, left + k] = min(lines[k, n], NONE)


@njit(cache=True, nogil=True, error_model="numpy")
def _envelope(heights: Line, spacing: int, first: int, lowest: Line, owner: Line, begin: Line) -> None:
    """Write the lower envelope of parabolas heights[i] + (q − p_i)² with apex p_i = spacing · i + first.

    Args:
        heights: (K,) of the apexes.
        spacing: Between apexes, and between the positions q = spacing · n of the result.
        first: Position of the first apex.
        lowest: (N,) result.
        owner: (K,) scratch: the parabolas of the envelope, from the left.
        begin: (K,) scratch: the n from which each is the lowest.
    """
    top = -1
    for k in range(len(heights)):
        if heights[k] >= NONE:
            continue
        apex = spacing * k + first
        start = 0
        while top >= 0:
            rival = spacing * owner[top] + first
            q = spacing * begin[top]
            if (q - rival) ** 2 + heights[owner[top]] <= (q - apex) ** 2 + heights[k]:
                rise = apex * apex - rival * rival + heights[k] - heights[owner[top]]
                start = 1 + rise // (2 * spacing * (apex - rival))
                break
            top -= 1
        if start < len(lowest):
            top += 1
            owner[top], begin[top] = k, start
    if top < 0:
        lowest[:] = NONE
        return
    for n in range(len(lowest) - 1, -1, -1):
        lowest[n] = (spacing * n - spacing * owner[top] - first) ** 2 + heights[owner[top]]
        if n == begin[top]:
            top -= 1
