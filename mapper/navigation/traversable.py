"""Traversable floor of a robot, from steps, slopes, drops and head room in the octree's columns."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Array
from mapper.navigation.config import TraversableConfig
from mapper.navigation.distance_transform import NONE, squares_to_boxes
from mapper.octree.keys import BLOCK_BITS, BLOCK_VOXELS, KEY_MASK, KEY_ZERO, block_keys, gather
from mapper.octree.map import OctreeMap
from mapper.octree.slice import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

_NOWHERE = -(1 << 30)
"""Height of the floor, in voxels, where none has been reached."""

_ALLOWANCE = 1e-6  # of a voxel: 0.1 m is two voxels of 5 cm, whatever the rounding of the division

Mask = NDArray[np.bool_]
Heights = NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    """Occupied voxels of every column, in order of height.

    Attributes:
        starts: (H·W + 1,) start of each column's voxels.
        tops: (N,) upper face of each voxel, in voxels above z = 0.
        shape: H, W.
        first: (2,) keys of the column of lowest x and y.
    """

    starts: NDArray[np.int64]
    tops: Heights
    shape: tuple[int, int]
    first: NDArray[np.int64]


def traversable(octree: OctreeMap, config: TraversableConfig, *, floor_z_m: float = 0.0) -> OccupancyGrid:
    """Return the grid of the floor that a robot can reach from the floor's height.

    A surface is the top of an occupied voxel with head room above it, where unknown voxels count as free.
    Surfaces at the height of the floor, and all that steps connect to them, are free. A column is occupied
    where an obstacle lies between step and head height, where the floor is too steep, or where it drops by
    more than a step; heights are relative to the nearest free floor. The rest is unknown.

    Args:
        octree: The map in a world with z up.
        config: Limits of the robot.
        floor_z_m: Height of the floor in the world.

    Raises:
        DataError: The map is empty.
    """
    if not len(octree):
        raise DataError("traversable floor: the map is empty; fuse scans into it first")
    columns, limits = _columns(octree), _limits(config, octree.resolution_m, floor_z_m)
    anywhere = np.ones(columns.shape, np.bool_)
    by_steps = _flooded(columns, limits, anywhere)
    steep = _slopes(by_steps, limits.window) > np.tan(config.max_slope_rad)
    floor = _flooded(columns, limits, ~steep)  # again: steep sides must not lead up to flat tops
    reached = floor > _NOWHERE
    cells = np.full(columns.shape, UNKNOWN, np.int8)
    if reached.any():
        blocked = (by_steps > _NOWHERE) & ~reached
        _add_obstacles(columns.starts, columns.tops, _nearest_height(floor), reached, limits, blocked)
        cells[_closed(reached, limits.gap)] = FREE
        cells[blocked] = OCCUPIED
        cells[(cells == FREE) & _within(blocked, config.robot_radius_m / octree.resolution_m)] = OCCUPIED
    return _cropped(cells, columns.first, octree.resolution_m)


class _Limits(NamedTuple):
    """Limits of the robot, in voxels.

    Attributes:
        floor_z: Height of the floor.
        tolerance: Surfaces this near to it are floor.
        step: Largest difference of heights between neighbours.
        room: Number of voxels above a surface that must not be occupied.
        gap: Number of columns between neighbours, at most.
        window: Number of columns of the slope's window on each side.
    """

    floor_z: float
    tolerance: float
    step: int
    room: int
    gap: int
    window: int


def _limits(config: TraversableConfig, cell_m: float, floor_z_m: float) -> _Limits:
    return _Limits(
        floor_z=floor_z_m / cell_m,
        tolerance=config.max_step_m / cell_m,
        step=int(config.max_step_m / cell_m + _ALLOWANCE),
        room=int(np.ceil(config.head_room_m / cell_m - _ALLOWANCE)),
        gap=int(config.max_gap_m / cell_m + _ALLOWANCE),
        window=max(1, round((config.slope_window_m / cell_m - 1.0) / 2.0)),
    )


def _flooded(columns: _Columns, limits: _Limits, allowed: Mask) -> Heights:
    """Return the height of the floor in every column that is connected to it over allowed columns."""
    floor = np.full(columns.shape, _NOWHERE, np.int32)
    _flood(columns.starts, columns.tops, limits, allowed, floor)
    return floor


def _cropped(cells: NDArray[np.int8], first: NDArray[np.int64], cell_m: float) -> OccupancyGrid:
    """Return the grid without unknown margins; a grid without known cells keeps its size."""
    rows, columns = (np.flatnonzero((cells != UNKNOWN).any(axis=axis)) for axis in (1, 0))
    if len(rows):
        cells = cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].copy()
        first = first + np.array([columns[0], rows[0]])
    return OccupancyGrid(cells, (first - KEY_ZERO).astype(np.float64) * cell_m, cell_m)


def _columns(octree: OctreeMap) -> _Columns:
    codes = octree.blocks.codes
    keys = block_keys(codes)[:, :2]
    first = keys.min(axis=0)
    width, height = (int(n) for n in keys.max(axis=0) - first + (1 << BLOCK_BITS))
    values = octree.blocks.table.values
    packed = np.sort(_occupied(codes, values, octree.occupied_log_odds))  # by y, then x, then z
    columns = ((packed >> 32) - first[1]) * width + (packed >> 16 & KEY_MASK) - first[0]
    starts = np.searchsorted(columns, np.arange(height * width + 1))
    tops = ((packed & KEY_MASK) + 1 - KEY_ZERO).astype(np.int32)
    return _Columns(starts, tops, (height, width), first)


@njit(cache=True, nogil=True)
def _occupied(
    codes: NDArray[np.int64], values: NDArray[np.float32], threshold: np.float32
) -> NDArray[np.int64]:
    """Return the keys of all occupied voxels as y · 2³² + x · 2¹⁶ + z."""
    count = 0
    for b in range(len(codes)):
        for voxel in range(BLOCK_VOXELS):
            count += values[b, voxel] >= threshold
    packed = np.empty(count, np.int64)
    count = 0
    for b in range(len(codes)):
        for voxel in range(BLOCK_VOXELS):
            if values[b, voxel] >= threshold:
                code = (codes[b] << (3 * BLOCK_BITS)) | voxel
                packed[count] = (gather(code >> 1) << 32) | (gather(code) << 16) | gather(code >> 2)
                count += 1
    return packed


@njit(cache=True, nogil=True)
def _surface(
    starts: NDArray[np.int64], tops: Heights, column: int, lowest: float, highest: float, room: int
) -> int:
    """Return the highest surface of a column between two heights, or _NOWHERE."""
    for n in range(starts[column + 1] - 1, starts[column] - 1, -1):
        if tops[n] < lowest:
            break
        is_surface = n + 1 == starts[column + 1] or tops[n + 1] - tops[n] > room
        if is_surface and tops[n] <= highest:
            return int(tops[n])
    return _NOWHERE


@njit(cache=True, nogil=True)
def _flood(starts: NDArray[np.int64], tops: Heights, limits: _Limits, allowed: Mask, floor: Heights) -> None:
    """Write the height of every surface that steps connect to the floor into ``floor`` (H, W)."""
    height, width = floor.shape
    queue = np.empty(height * width, np.int64)
    count = done = 0
    lowest, highest = limits.floor_z - limits.tolerance, limits.floor_z + limits.tolerance
    for column in range(height * width):
        found = _surface(starts, tops, column, lowest, highest, limits.room)
        if found != _NOWHERE and allowed[column // width, column % width]:
            floor[column // width, column % width] = found
            queue[count] = column
            count += 1
    reach = limits.gap + 1
    while done < count:
        row, column = queue[done] // width, queue[done] % width
        here = floor[row, column]
        done += 1
        for y in range(max(row - reach, 0), min(row + reach + 1, height)):
            for x in range(max(column - reach, 0), min(column + reach + 1, width)):
                if floor[y, x] != _NOWHERE or not allowed[y, x]:
                    continue
                found = _surface(
                    starts, tops, y * width + x, here - limits.step, here + limits.step, limits.room
                )
                if found != _NOWHERE:
                    floor[y, x] = found
                    queue[count] = y * width + x
                    count += 1


def _nearest_height(floor: Heights) -> Heights:
    """Return the height of the nearest floor in every column."""
    reached = floor > _NOWHERE
    _, labels = cv2.distanceTransformWithLabels(
        (~reached).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    height_of = np.empty(int(labels.max()) + 1, np.int32)
    height_of[labels[reached]] = floor[reached]
    level: Heights = height_of[labels]
    return level


@njit(cache=True, nogil=True)
def _add_obstacles(
    starts: NDArray[np.int64], tops: Heights, level: Heights, reached: Mask, limits: _Limits, blocked: Mask
) -> None:
    """Mark columns off the floor with a voxel between step and head height, or deeper than a step."""
    height, width = level.shape
    for row in range(height):
        for column in range(width):
            if reached[row, column]:
                continue
            for n in range(starts[row * width + column], starts[row * width + column + 1]):
                rise = tops[n] - level[row, column]
                if rise < -limits.step or limits.step < rise <= limits.room:
                    blocked[row, column] = True


def _closed(reached: Mask, gap: int) -> Mask:
    """Return the floor with gaps of up to ``gap`` columns closed."""
    square = np.ones((gap + 1, gap + 1), np.uint8)
    around = cv2.copyMakeBorder(reached.astype(np.uint8), gap, gap, gap, gap, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(around, cv2.MORPH_CLOSE, square)
    filled: Mask = closed[gap : gap + reached.shape[0], gap : gap + reached.shape[1]].astype(np.bool_)
    return filled


def _slopes(floor: Heights, reach: int) -> Array:
    """Return the (H, W) rise over run of the least-squares plane through the floor in a square window.

    Where the window's floor is a single line or point, the slope is 0.
    """
    offsets = np.arange(-reach, reach + 1, dtype=np.float64)
    ones = np.ones_like(offsets)
    reached = floor > _NOWHERE
    known = reached.astype(np.float64)
    z = np.where(reached, floor, 0).astype(np.float64)

    def total(values: Array, along_x: Array, along_y: Array) -> Array:
        summed: Array = np.asarray(
            cv2.sepFilter2D(values, cv2.CV_64F, along_x, along_y, borderType=cv2.BORDER_CONSTANT)
        )
        return summed

    n, x, y = total(known, ones, ones), total(known, offsets, ones), total(known, ones, offsets)
    xx, yy = total(known, offsets**2, ones), total(known, ones, offsets**2)
    xy = total(known, offsets, offsets)
    sum_z, xz, yz = total(z, ones, ones), total(z, offsets, ones), total(z, ones, offsets)
    # Moments about the mean, times n², so that all of these sums are whole numbers.
    cxx, cyy, cxy = n * xx - x * x, n * yy - y * y, n * xy - x * y
    cxz, cyz = n * xz - x * sum_z, n * yz - y * sum_z
    determinant = cxx * cyy - cxy * cxy
    flat = determinant <= 0.0
    determinant[flat] = 1.0
    rise = np.hypot(cyy * cxz - cxy * cyz, cxx * cyz - cxy * cxz) / determinant
    rise[flat] = 0.0
    return np.asarray(rise, np.float64)


def _within(obstacles: Mask, radius: float) -> Mask:
    """Return the cells whose centres are nearer than a radius, in cells, to an obstacle."""
    squares = squares_to_boxes(obstacles[np.newaxis])[0]
    near: Mask = (squares != NONE) & (np.sqrt(squares) / 2.0 < radius - _ALLOWANCE)
    return near
