"""Nearest obstacle of a point, searched in the map's blocks, without a distance field."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy import float64, int16, int64
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Array, Points
from mapper.octree.blocks import BlockStore, slot_of
from mapper.octree.keys import BLOCK_BITS, BLOCK_VOXELS, KEY_MASK, KEY_ZERO, gather, morton

_EDGE = 1 << BLOCK_BITS
_LAST_BLOCK = KEY_MASK >> BLOCK_BITS
_NOT_LISTED = -1
_OFFSETS: NDArray[np.int64] = np.column_stack(
    [gather.py_func(np.arange(BLOCK_VOXELS) >> axis) for axis in range(3)]
)
"""(512, 3) keys of a block's voxels relative to its first, in Morton order."""


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """Nearest obstacles of N points.

    Attributes:
        centres_world: (N, 3) float64 centre of the nearest occupied voxel, metres; NaN if none is in range.
            Of equally near ones it is the first in Morton order.
        distances_m: (N,) float64 to that centre; inf where none is in range.
    """

    centres_world: Points
    distances_m: Array


def nearest_occupied(
    store: BlockStore, points_world: Points, *, resolution_m: float, max_range_m: float, threshold: np.float32
) -> Nearest:
    """Find the occupied voxel whose centre is nearest to each point.

    Args:
        store: The voxels.
        points_world: (N, 3) metres, inside the map or not.
        resolution_m: Edge of a voxel.
        max_range_m: Range of the search; inf searches everywhere.
        threshold: Log-odds from which a voxel is occupied.

    Raises:
        DataError: The points are not (N, 3) or not finite, or the range is negative.
    """
    points = np.asarray(points_world, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise DataError(f"octree: nearest obstacles of points {points.shape}, want (N, 3), all finite")
    if not max_range_m >= 0.0:
        raise DataError(f"octree: nearest obstacles within {max_range_m} m, want a range ≥ 0")
    # Filled for a block when a search first reaches it: other blocks cost nothing.
    counts = np.full(len(store), _NOT_LISTED, np.int16)
    members = np.empty((len(store), BLOCK_VOXELS), np.int16)
    codes, squares = _search(
        store.table,
        store.codes,
        counts,
        members,
        points / resolution_m + (KEY_ZERO - 0.5),
        max_range_m / resolution_m,
        threshold,
    )
    keys = np.column_stack([gather.py_func(codes >> axis) for axis in range(3)])
    centres_world = (keys - (KEY_ZERO - 0.5)) * resolution_m
    centres_world[codes < 0] = np.nan
    return Nearest(centres_world, np.sqrt(squares) * resolution_m)


@njit(cache=True, nogil=True)
def _search(table, block_codes, counts, members, points, reach, threshold):
    """Return (N,) int64 Morton codes, −1 where there is none, and (N,) squared distances.

    Lengths are in voxels, and points in keys: a voxel's centre lies at its key. Shells of blocks around a
    point are searched from the inside, until one is further away than the nearest voxel so far.
    """
    found, squares = np.full(len(points), -1, int64), np.full(len(points), np.inf)
    home = np.empty(3, int64)
    for i in range(len(points)):
        point = points[i]
        for axis in range(3):
            key = min(max(point[axis] + 0.5, 0.0), float64(KEY_MASK))
            home[axis] = int64(key) >> BLOCK_BITS
        best, nearest = reach * reach, int64(-1)
        shell = 0
        while True:
            # Lower bound of the shell's distance; from a point off the map it is further away.
            gap = max(shell - 1, 0) * float64(_EDGE)
            if gap * gap > best:
                break
            if (2 * shell + 1) ** 3 > len(block_codes):
                for slot in range(len(block_codes)):
                    best, nearest = _visit(
                        table, slot, block_codes[slot], counts, members, point, threshold, best, nearest
                    )
                break
            for dz in range(-shell, shell + 1):
                for dy in range(-shell, shell + 1):
                    on_side = abs(dz) == shell or abs(dy) == shell
                    for dx in range(-shell, shell + 1, 1 if on_side else 2 * shell):
                        x, y, z = home[0] + dx, home[1] + dy, home[2] + dz
                        if min(x, y, z) < 0 or max(x, y, z) > _LAST_BLOCK:
                            continue
                        if _gap_square(point, x, y, z) > best:
                            continue
                        code = morton(x, y, z)
                        slot = slot_of(table, code)
                        if slot >= 0:
                            best, nearest = _visit(
                                table, slot, code, counts, members, point, threshold, best, nearest
                            )
            shell += 1
        found[i] = nearest
        if nearest >= 0:
            squares[i] = best
    return found, squares


@njit(cache=True, nogil=True)
def _gap_square(point, x, y, z):
    """Return the squared distance from a point to a block's faces."""
    gap_x = max(x * _EDGE - 0.5 - point[0], point[0] - (x * _EDGE + _EDGE - 0.5), 0.0)
    gap_y = max(y * _EDGE - 0.5 - point[1], point[1] - (y * _EDGE + _EDGE - 0.5), 0.0)
    gap_z = max(z * _EDGE - 0.5 - point[2], point[2] - (z * _EDGE + _EDGE - 0.5), 0.0)
    return gap_x * gap_x + gap_y * gap_y + gap_z * gap_z


@njit(cache=True, nogil=True)
def _visit(table, slot, code, counts, members, point, threshold, best, nearest):
    """Return squared distance and code of the nearest voxel so far, after a block's occupied voxels."""
    if counts[slot] == _NOT_LISTED:
        counts[slot] = _list_occupied(table.values[slot], threshold, members[slot])
    if counts[slot] == 0:
        return best, nearest
    x, y, z = gather(code), gather(code >> 1), gather(code >> 2)
    if _gap_square(point, x, y, z) > best:
        return best, nearest
    x0, y0, z0 = x * _EDGE - point[0], y * _EDGE - point[1], z * _EDGE - point[2]
    for i in range(counts[slot]):
        voxel = members[slot, i]
        dx, dy, dz = x0 + _OFFSETS[voxel, 0], y0 + _OFFSETS[voxel, 1], z0 + _OFFSETS[voxel, 2]
        square = dx * dx + dy * dy + dz * dz
        if square <= best:
            candidate = (code << (3 * BLOCK_BITS)) | voxel
            if square < best or nearest < 0 or candidate < nearest:
                best, nearest = square, candidate
    return best, nearest


@njit(cache=True, nogil=True)
def _list_occupied(block, threshold, members):
    """Write the numbers of a block's occupied voxels; return their count."""
    count = 0
    for voxel in range(BLOCK_VOXELS):
        members[count] = int16(voxel)
        count += block[voxel] >= threshold
    return int16(count)
