"""Traversable floor of a robot as grids, one a storey: floor, obstacles, drops and steep parts."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.navigation.config import TraversableConfig
from mapper.navigation.distance_transform import NONE, squares_to_boxes
from mapper.navigation.flood import Limits, Mask
from mapper.navigation.floor import Floor
from mapper.navigation.storeys import Heights, storeys_of
from mapper.octree.columns import NOWHERE, Columns, nearest_heights
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.keys import KEY_ZERO

_ALLOWANCE = 1e-6
_NEAR_M = 1.0
_RISER_M = 0.4
_FAR = 1e6  # voxels: the key range is smaller


@dataclass(frozen=True, slots=True, eq=False)
class Storey:
    """One storey of a floor.

    Attributes:
        grid: Floor, obstacles, unknown.
        heights: (H, W) int32 heights of the floor in voxels above z = 0, in the grid's cells; NOWHERE
            where it was not seen.
    """

    grid: OccupancyGrid
    heights: Heights


@dataclass(frozen=True, slots=True, eq=False)
class TraversableFloor:
    """Floor that a robot can reach.

    Attributes:
        storeys: Its storeys, the lowest first; at least one.
        home_number: Number of the storey on which the path begins.
        links: Floor where two storeys meet, over which paths lead from one to the other; empty unless it was
            looked for.
    """

    storeys: tuple[Storey, ...]
    home_number: int
    links: tuple[Storey, ...]

    @property
    def home(self) -> Storey:
        """The storey on which the path begins."""
        return self.storeys[self.home_number]

    @property
    def over_each_other(self) -> tuple[OccupancyGrid, ...]:
        """The grids of all storeys, the lowest first; empty where no floor lies over another."""
        return tuple(storey.grid for storey in self.storeys) if len(self.storeys) > 1 else ()


def traversable(floor: Floor, config: TraversableConfig, *, with_links: bool = False) -> TraversableFloor:
    """Return the floor that a robot can reach, as grids.

    Floor is free, small gaps in it included. A cell is occupied where an obstacle lies between step and head
    height, where the ground is too steep, and where it drops by more than a step; heights are relative to the
    nearest floor of the storey. The rest is unknown. Without floor the grid is all unknown.

    Args:
        floor: The floor.
        config: The limits by which it was found, and the robot's radius.
        with_links: Whether links between storeys are looked for.
    """
    storeys, links = storeys_of(floor, with_links=with_links)
    return TraversableFloor(
        tuple(_storey(floor, heights, config) for heights in storeys),
        _home_number(floor, storeys),
        tuple(_storey(floor, heights, config) for heights in links),
    )


def _home_number(floor: Floor, storeys: list[Heights]) -> int:
    """Return the number of the storey nearest to the path's ground, where the path first has floor below."""
    columns = floor.columns
    points = floor.path.points_world / columns.resolution_m
    places = np.floor(points[:, :2]).astype(np.int64)[:, ::-1] - (columns.first[::-1] - KEY_ZERO)
    inside = ((places >= 0) & (places < columns.shape)).all(axis=1)  # a frame without points may lie outside
    tops = np.array([heights[tuple(places[inside].T)] for heights in storeys])
    has_floor = tops > NOWHERE
    first = np.flatnonzero(has_floor.any(axis=0))[:1]
    if not len(first):
        return 0
    away = np.where(has_floor, np.abs(tops - points[inside, 2]), np.inf)
    return int(np.argmin(away[:, first[0]]))


def _storey(floor: Floor, heights: Heights, config: TraversableConfig) -> Storey:
    columns, limits = floor.columns, floor.limits
    reached = heights > NOWHERE
    cells = np.full(columns.shape, UNKNOWN, np.int8)
    if reached.any():
        level, distances = nearest_heights(heights)
        is_near = distances * columns.resolution_m <= _NEAR_M
        blocked = _obstacles(columns, limits, floor.steep, level, ~reached, is_near)
        riser = max(limits.step, round(_RISER_M / columns.resolution_m))
        _add_edges(heights, _driven(floor, heights), limits.step, riser, blocked)
        closed = _closed(reached, limits.gap)
        cells[closed] = FREE
        blocked |= closed & ~reached & _is_edge(heights, limits)
        cells[blocked] = OCCUPIED
        cells[(cells == FREE) & _within(blocked, config.robot_radius_m / columns.resolution_m)] = OCCUPIED
    origin_world_m = (columns.first - KEY_ZERO).astype(np.float64) * columns.resolution_m
    return trimmed(Storey(OccupancyGrid(cells, origin_world_m, columns.resolution_m), heights))


def trimmed(storey: Storey) -> Storey:
    """Return a storey without unknown margins."""
    cells, resolution_m = storey.grid.cells, storey.grid.resolution_m
    rows, across = (_known(cells, axis) for axis in (1, 0))
    first = np.rint(storey.grid.origin_world_m / resolution_m) + np.array([across.start, rows.start])
    grid = OccupancyGrid(cells[rows, across].copy(), first * resolution_m, resolution_m)
    return replace(storey, grid=grid, heights=storey.heights[rows, across].copy())


def _known(cells: NDArray[np.int8], axis: int) -> slice:
    """Return the range of rows or columns with known cells; all of them if there is none."""
    known = np.flatnonzero((cells != UNKNOWN).any(axis=axis))
    return slice(known[0], known[-1] + 1) if len(known) else slice(0, cells.shape[1 - axis])


@njit(cache=True, nogil=True)
def _obstacles(
    columns: Columns, limits: Limits, steep: Mask, level: Heights, wanted: Mask, is_near: Mask
) -> Mask:
    """Return the (H, W) mask of the wanted columns that a robot cannot pass.

    These have an obstacle between step and head height above the floor's level or, near floor, a drop or a
    steep part.
    """
    height, width = level.shape
    blocked = np.zeros(level.shape, np.bool_)
    for row in range(height):
        for column in range(width):
            if not wanted[row, column]:
                continue
            for n in range(columns.starts[row * width + column], columns.starts[row * width + column + 1]):
                rise = columns.tops[n] - level[row, column]
                is_unfit = rise < -limits.step or (steep[n] and rise <= limits.room)
                if limits.step < rise <= limits.room or (is_near[row, column] and is_unfit):
                    blocked[row, column] = True
    return blocked


def _driven(floor: Floor, heights: Heights) -> Mask:
    """Return the (H, W) mask of the columns in which the floor of a storey is ground under the path."""
    columns = floor.columns.column_of[floor.driven]
    of_storey = heights.ravel()[columns] == floor.columns.tops[floor.driven]
    driven = np.zeros(heights.shape, np.bool_)
    driven.ravel()[columns[of_storey]] = True
    return driven


@njit(cache=True, nogil=True)
def _add_edges(heights: Heights, driven: Mask, step: int, riser: int, blocked: Mask) -> None:
    """Mark floor beside floor that lies more than a step lower; the lower one if the path led over this one.

    Where the path led over both, as over a riser, it joins them.
    """
    height, width = heights.shape
    for row in range(height):
        for column in range(width):
            here = heights[row, column]
            if here == NOWHERE:
                continue
            for y in range(max(row - 1, 0), min(row + 2, height)):
                for x in range(max(column - 1, 0), min(column + 2, width)):
                    if heights[y, x] == NOWHERE or here - heights[y, x] <= step:
                        continue
                    is_turn = here - heights[y, x] > riser  # of a spiral: the path did not step there
                    if not driven[row, column] or (driven[y, x] and is_turn):
                        blocked[row, column] = True
                    elif not driven[y, x]:
                        blocked[y, x] = True


def _closed(reached: Mask, gap: int) -> Mask:
    """Return the floor with gaps of up to ``gap`` columns closed."""
    square = np.ones((gap + 1, gap + 1), np.uint8)
    around = cv2.copyMakeBorder(reached.astype(np.uint8), gap, gap, gap, gap, cv2.BORDER_CONSTANT, value=0)
    # The anchors mirror each other: those of cv2.MORPH_CLOSE would shift the floor if the edge is even.
    low, high = gap // 2, gap - gap // 2
    closed = cv2.erode(cv2.dilate(around, square, anchor=(low, low)), square, anchor=(high, high))
    filled: Mask = closed[gap : gap + reached.shape[0], gap : gap + reached.shape[1]].astype(np.bool_)
    return filled


def _is_edge(heights: Heights, limits: Limits) -> Mask:
    """Return the mask of the columns within a gap of which floor lies that no slope joins."""
    square = np.ones((2 * limits.gap + 1, 2 * limits.gap + 1), np.uint8)
    missing = heights == NOWHERE
    highest, lowest = heights.astype(np.float32), heights.astype(np.float32)
    highest[missing], lowest[missing] = -_FAR, _FAR
    rise = cv2.dilate(highest, square) - cv2.erode(lowest, square)
    edge: Mask = rise > limits.step + limits.slope * len(square)
    return edge


def _within(obstacles: Mask, radius: float) -> Mask:
    """Return the cells whose centres are nearer than a radius, in cells, to an obstacle."""
    if radius <= 0.0:
        return np.zeros_like(obstacles)
    squares = squares_to_boxes(obstacles[np.newaxis])[0]
    near: Mask = (squares != NONE) & (np.sqrt(squares) / 2.0 < radius - _ALLOWANCE)
    return near
