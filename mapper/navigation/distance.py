"""Distances to obstacles: of a grid's cells, and signed distance fields of the map's voxels.

The transform to whole voxels is exact, in integers (after Meijster, Roerdink & Hesselink 2000). As in
Felzenszwalb & Huttenlocher (2012) the lower envelope of parabolas is taken axis after axis, in linear time;
borders between parabolas are kept as the first whole cell, so nothing is rounded.
``scipy.ndimage.distance_transform_edt`` has distances to centres only, and takes three times as long.
"""

from dataclasses import dataclass
from math import prod

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError, MapSizeError, expect_shape
from mapper.core.geometry import Array, Points
from mapper.core.units import MIB
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.keys import BLOCK_EDGE, KEY_ZERO, block_keys
from mapper.octree.map import OctreeMap

Distances = NDArray[np.float32]
Squares = NDArray[np.int32]
Line = NDArray[np.int64]

LIMIT_BYTES = 2048 * MIB
"""Limit of the working space of a plan."""
NONE = np.iinfo(np.int32).max
"""Squared distance where there is no target at all."""

_MOST_CELLS = 13_000  # along an edge: three squares of twice as many still fit into an int32
_LINES = 16  # processed together: 16 int32 fill a cache line


@dataclass(frozen=True, slots=True, eq=False)
class VoxelGrid:
    """States of every voxel of a box; a slice is a grid of one layer.

    Attributes:
        states: (Z, Y, X) int8 of UNKNOWN, FREE and OCCUPIED.
        corner_world_m: (3,) lower x, y, z of voxel [0, 0, 0].
        resolution_m: Edge of a voxel.
    """

    states: NDArray[np.int8]
    corner_world_m: Array
    resolution_m: float

    def blocked(self, *, unknown_blocks: bool) -> NDArray[np.bool_]:
        """Return the (Z, Y, X) mask of occupied voxels and, if they block, of unknown ones."""
        blocked: NDArray[np.bool_] = (self.states == OCCUPIED) | ((self.states == UNKNOWN) & unknown_blocks)
        return blocked


def dense_voxels(octree: OctreeMap, *, bytes_per_voxel: int) -> VoxelGrid:
    """Return the states of all voxels of the map's 8³ blocks, with a layer of unknown voxels around them.

    Args:
        octree: The map.
        bytes_per_voxel: Working space of the caller per voxel, these states included.

    Raises:
        MapSizeError: More space is needed; nothing has been allocated then.
        DataError: The map is empty.
    """
    codes = octree.blocks.codes
    if not len(codes):
        raise DataError("octree: the map is empty; fuse scans into it first")
    keys = block_keys(codes)
    first = keys.min(axis=0) - 1
    counts = [int(n) for n in keys.max(axis=0) + BLOCK_EDGE + 1 - first]
    needed_bytes = bytes_per_voxel * prod(counts)
    if needed_bytes > LIMIT_BYTES:
        raise MapSizeError(
            f"a box of {'×'.join(str(n) for n in counts)} voxels needs {needed_bytes / 2**30:.1f} GiB of "
            f"working space, the limit is {LIMIT_BYTES / 2**30:.1f}; plan in a smaller or a coarser map"
        )
    states = np.full(counts[::-1], UNKNOWN, dtype=np.int8)
    for known in octree.leaves_by_part():
        x, y, z = (known.keys - first).T
        states[z, y, x] = np.where(known.log_odds >= octree.occupied_log_odds, OCCUPIED, FREE)
    corner_world_m = (first - KEY_ZERO).astype(np.float64) * octree.resolution_m
    return VoxelGrid(states, corner_world_m, octree.resolution_m)


def layer(grid: OccupancyGrid) -> VoxelGrid:
    """Return a 2D grid as one layer of voxels, surrounded by a ring of unknown cells."""
    states = np.pad(grid.cells, 1, constant_values=UNKNOWN)[np.newaxis]
    x, y = grid.origin_world_m - grid.resolution_m
    return VoxelGrid(states, np.array([x, y, -grid.resolution_m / 2.0]), grid.resolution_m)


@dataclass(frozen=True, slots=True, eq=False)
class DistanceField:
    """Signed distances at the centres of a box's voxels.

    Attributes:
        distances_m: (Z, Y, X) float32 result of :func:`signed_distances`.
        corner_world_m: (3,) lower x, y, z of voxel [0, 0, 0].
        resolution_m: Edge of a voxel.
    """

    distances_m: Distances
    corner_world_m: Array
    resolution_m: float

    def distance(self, points_world: Points) -> Distances:
        """Return (N,) metres at (N, 3) points, trilinear between centres; NaN outside the box.

        Raises:
            DataError: The points are not (N, 3).
        """
        expect_shape(points_world, "N,3", "distance field: points")
        cells = np.ascontiguousarray((points_world - self.corner_world_m) / self.resolution_m, np.float64)
        found: Distances = _interpolate(self.distances_m, cells)
        return found


def distance_field(voxels: VoxelGrid, *, unknown_blocks: bool) -> DistanceField:
    """Return the distance field of a voxel grid."""
    distances_m = signed_distances(voxels.blocked(unknown_blocks=unknown_blocks), voxels.resolution_m)
    return DistanceField(distances_m, voxels.corner_world_m, voxels.resolution_m)


def signed_distances(blocked: NDArray[np.bool_], resolution_m: float) -> Distances:
    """Return the exact distance of each cell's centre to the surface between free and blocked cells.

    Args:
        blocked: (Z, Y, X).
        resolution_m: Edge of a cell.

    Returns:
        (Z, Y, X) float32 metres: positive in free cells, to the nearest square or cube that is blocked;
        negative in blocked ones; +inf where nothing is blocked, −inf where everything is.
    """
    distances = _half_cells(squares_to_boxes(blocked))
    distances[blocked] = -_half_cells(squares_to_boxes(~blocked))[blocked]
    distances *= np.float32(resolution_m / 2.0)
    return distances


def _half_cells(squares: Squares) -> Distances:
    distances = np.sqrt(squares, dtype=np.float32)
    distances[squares == NONE] = np.inf
    return distances


def plane_distances(targets: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return (H, W) distance of every cell's centre to that of the nearest target of (H, W), in cells.

    It is +inf where there is no target.
    """
    from scipy.ndimage import distance_transform_edt  # takes a while to load, which most maps do not need

    if not targets.any():
        return np.full(targets.shape, np.inf)
    return np.asarray(distance_transform_edt(~targets), np.float64)


def squares_to_boxes(targets: NDArray[np.bool_]) -> Squares:
    """Return the squared distance of every cell's centre to the nearest target's surface, in quarter cells².

    A target is its whole square or cube, and distances are counted in half cells, which keeps them integers.

    Args:
        targets: (Z, Y, X); a plane is (1, H, W).

    Returns:
        (Z, Y, X) int32, 0 on targets; NONE everywhere if there is no target.

    Raises:
        MapSizeError: An edge is too long for the squares to fit into an int32.
    """
    depth, height, width = targets.shape
    if max(targets.shape) > _MOST_CELLS:
        raise MapSizeError(
            f"distances in {depth}×{height}×{width} cells: an edge may have {_MOST_CELLS}; "
            "choose a smaller box or a coarser map"
        )
    squares = np.empty(targets.shape, np.int32)
    _along_rows(np.ascontiguousarray(targets), squares)
    _across_rows(squares)
    _across_rows(squares.reshape(1, depth, height * width))
    return squares


@njit(cache=True, nogil=True)
def _along_rows(targets: NDArray[np.bool_], squares: Squares) -> None:
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
                nearest = max(2 * min(gap, squares[z, y, x]) - 1, 0)
                squares[z, y, x] = nearest * nearest if found else NONE


@njit(cache=True, nogil=True)
def _across_rows(squares: Squares) -> None:
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
                # A cell's two faces across this axis; neighbours share one. Between them the cell's own
                # value holds, which is the lowest parabola's apex or less.
                heights[0], heights[length] = line[0], line[length - 1]
                for n in range(1, length):
                    heights[n] = min(line[n - 1], line[n])
                _take_envelope(heights, lowest, owner, begin)
                for n in range(length):
                    line[n] = min(line[n], lowest[n])
            for n in range(length):
                for k in range(together):
                    squares[a, n, left + k] = min(lines[k, n], NONE)


@njit(cache=True, nogil=True, error_model="numpy")
def _take_envelope(heights: Line, lowest: Line, owner: Line, begin: Line) -> None:
    """Write the lower envelope of parabolas heights[i] + (2 n − p_i)² with apex p_i = 2 i − 1, in half cells.

    Args:
        heights: (N + 1,) of the apexes.
        lowest: (N,) result at the cells' centres.
        owner: (N + 1,) scratch: the parabolas of the envelope, from the left.
        begin: (N + 1,) scratch: the n from which each is the lowest.
    """
    top = -1
    for k in range(len(heights)):
        if heights[k] >= NONE:
            continue
        apex, start = 2 * k - 1, 0
        while top >= 0:
            rival, q = 2 * owner[top] - 1, 2 * begin[top]
            if (q - rival) ** 2 + heights[owner[top]] <= (q - apex) ** 2 + heights[k]:
                rise = apex * apex - rival * rival + heights[k] - heights[owner[top]]
                start = 1 + rise // (4 * (apex - rival))
                break
            top -= 1
        if start < len(lowest):
            top += 1
            owner[top], begin[top] = k, start
    if top < 0:
        lowest[:] = NONE
        return
    for n in range(len(lowest) - 1, -1, -1):
        lowest[n] = (2 * n - 2 * owner[top] + 1) ** 2 + heights[owner[top]]
        if n == begin[top]:
            top -= 1


@njit(cache=True, nogil=True)
def _interpolate(distances: Distances, points: Points) -> Distances:
    """Return the (N,) trilinear values at (N, 3) x, y, z in cells; NaN outside the box."""
    found = np.full(len(points), np.nan, np.float32)
    depth, height, width = distances.shape
    for i in range(len(points)):
        x, y, z = points[i]
        if 0.0 <= x <= width and 0.0 <= y <= height and 0.0 <= z <= depth:
            found[i] = interpolate_at(distances, z, y, x)
    return found


@njit(cache=True, nogil=True)
def interpolate_at(distances: Distances, z: float, y: float, x: float) -> float:
    """Return the trilinear value at a position in cells: cell [0, 0, 0] spans 0 … 1.

    Beyond the outermost centres the value is constant.
    """
    depth, height, width = distances.shape
    z0, z1, up_z = _between(z, depth)
    y0, y1, up_y = _between(y, height)
    x0, x1, up_x = _between(x, width)
    if np.isinf(distances[z0, y0, x0]):
        return float(distances[z0, y0, x0])  # then all are infinite
    a, b = _mix(distances, z0, y0, x0, x1, up_x), _mix(distances, z0, y1, x0, x1, up_x)
    c, d = _mix(distances, z1, y0, x0, x1, up_x), _mix(distances, z1, y1, x0, x1, up_x)
    low, high = a + up_y * (b - a), c + up_y * (d - c)
    value: float = low + up_z * (high - low)
    return value


@njit(cache=True, nogil=True)
def _between(position: float, count: int) -> tuple[int, int, float]:
    """Return the cells with centres around a position, and its fraction between them."""
    clamped = min(max(position - 0.5, 0.0), count - 1.0)
    low = int(clamped)
    return low, min(low + 1, count - 1), clamped - low


@njit(cache=True, nogil=True)
def _mix(distances: Distances, z: int, y: int, x0: int, x1: int, up: float) -> float:
    low, high = float(distances[z, y, x0]), float(distances[z, y, x1])
    return low + up * (high - low)
