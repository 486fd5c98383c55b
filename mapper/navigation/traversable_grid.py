"""Traversable floor of a robot as grids, one a storey: floor, obstacles, drops and steep parts."""

from dataclasses import dataclass, replace
from heapq import heappop, heappush
from itertools import combinations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.navigation.config import TraversableConfig
from mapper.navigation.distance import NONE, squares_to_boxes
from mapper.navigation.floor_kernels import ALLOWANCE, Indices, Limits, Mask, around
from mapper.navigation.reachable_floor import Floor
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.keys import KEY_ZERO
from mapper.octree.occupied_columns import NEAR_FLOOR_M, NOWHERE, Columns, nearest_heights, starts_of

Heights = NDArray[np.int32]

_LEAST_AREA_M2 = 1.0
_OVERLAP_M = 3.0
_NONE = -1
_RISER_M = 0.4


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
        is_near = distances * columns.resolution_m <= NEAR_FLOOR_M
        blocked = _find_obstacles(columns, limits, floor.steep, level, ~reached, is_near)
        riser = max(limits.step, round(_RISER_M / columns.resolution_m))
        _add_edges(heights, _mask_driven(floor, heights), limits.step, riser, blocked)
        closed = _close_gaps(reached, limits.gap)
        cells[closed] = FREE
        blocked |= closed & ~reached & _is_edge(heights, limits)
        cells[blocked] = OCCUPIED
        cells[(cells == FREE) & _within(blocked, config.robot_radius_m / columns.resolution_m)] = OCCUPIED
    origin_world_m = (columns.first - KEY_ZERO).astype(np.float64) * columns.resolution_m
    return trim(Storey(OccupancyGrid(cells, origin_world_m, columns.resolution_m), heights))


def trim(storey: Storey) -> Storey:
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
def _find_obstacles(
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


def _mask_driven(floor: Floor, heights: Heights) -> Mask:
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


def _close_gaps(reached: Mask, gap: int) -> Mask:
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
    lowest = np.where(heights == NOWHERE, -NOWHERE, heights).astype(np.float32)
    rise = cv2.dilate(heights.astype(np.float32), square) - cv2.erode(lowest, square)
    edge: Mask = rise > limits.step + limits.slope * len(square)
    return edge


def _within(obstacles: Mask, radius: float) -> Mask:
    """Return the cells whose centres are nearer than a radius, in cells, to an obstacle."""
    if radius <= 0.0:
        return np.zeros_like(obstacles)
    squares = squares_to_boxes(obstacles[np.newaxis])[0]
    near: Mask = (squares != NONE) & (np.sqrt(squares) / 2.0 < radius - ALLOWANCE)
    return near


def storeys_of(floor: Floor, *, with_links: bool = False) -> tuple[list[Heights], list[Heights]]:
    """Return the (H, W) heights, in voxels above z = 0, of every storey's floor, the lowest first; and links.

    Where floors lie over each other, each is a storey; every other surface belongs to the storey to which one
    climbs or descends least. A storey goes on for some metres over the ramps and stairs that lead from it, so
    that neighbours share these surfaces. One that is neither as large as a square metre nor under the path is
    left out, unless all are. A floor without any other above is a single storey.

    A link is the floor for some metres to both sides of where two storeys meet. On spiral stairs, a turn of
    which fills a storey, it is all that joins them. Without ``with_links`` none is looked for.
    """
    columns, reached = floor.columns, floor.reached
    heights = np.full(columns.shape, NOWHERE, np.int32)
    column_of, tops = columns.column_of[reached], columns.tops[reached]
    if not (np.diff(column_of) == 0).any():
        heights.ravel()[column_of] = tops
        return [heights], []
    columns = columns._replace(starts=starts_of(column_of, len(columns.starts) - 1), tops=tops)
    limits, driven = floor.limits, floor.driven[reached]
    storey = np.full(len(tops), _NONE, np.int32)
    sources = np.zeros(len(tops), np.bool_)
    sources[np.argmin(np.where(driven, tops, tops.max())) if driven.any() else np.argmin(tops)] = True
    _climb(columns, column_of, limits, sources, storey)
    # Floors that lie over each other are separate storeys; all else goes to the nearer of them.
    shared = np.diff(columns.starts)[column_of] > 1
    storey[~shared] = _NONE
    _climb(columns, column_of, limits, shared, storey)
    cell_m = columns.resolution_m
    sizes = np.bincount(storey)
    kept = [
        number
        for number in np.flatnonzero(sizes).tolist()
        if sizes[number] * cell_m**2 >= _LEAST_AREA_M2 or (driven & (storey == number)).any()
    ] or [int(np.argmax(sizes))]
    kept.sort(key=lambda number: float(np.median(tops[storey == number])))
    reach = round(_OVERLAP_M / cell_m)

    def extend(own: Mask) -> Heights:
        _extend(columns, column_of, limits.step, reach, own)
        heights = np.full(columns.shape, NOWHERE, np.int32)
        heights.ravel()[column_of[own]] = tops[own]
        return heights

    pairs = combinations(kept, 2) if with_links else ()
    borders = [_border(columns, column_of, limits, storey, pair) for pair in pairs]
    links = [extend(border) for border in borders if border.any()]
    return [extend(storey == number) for number in kept], links


@njit(cache=True, nogil=True)
def _border(
    columns: Columns,
    column_of: Indices,
    limits: Limits,
    storey: NDArray[np.int32],
    pair: tuple[int, int],
) -> Mask:
    """Return the mask of the surfaces of two storeys from which a step, or a gap, leads to the other."""
    starts, tops, width = columns.starts, columns.tops, columns.shape[1]
    border = np.zeros(len(tops), np.bool_)
    for n in range(len(tops)):
        if storey[n] != pair[0]:
            continue
        low_y, high_y, low_x, high_x = around(column_of[n], limits.gap + 1, columns.shape)
        for y in range(low_y, high_y):
            for m in range(starts[y * width + low_x], starts[y * width + high_x]):  # a row of columns
                if storey[m] == pair[1] and abs(tops[m] - tops[n]) <= limits.step:
                    border[n] = border[m] = True
    return border


@njit(cache=True, nogil=True)
def _climb(
    columns: Columns,
    column_of: Indices,
    limits: Limits,
    sources: Mask,
    storey: NDArray[np.int32],
) -> None:
    """Give every surface the storey of the source from which one climbs least, or the next free one above.

    Sources without a storey are of storey 0, as are surfaces that neither steps nor gaps lead to.
    """
    starts, tops, width = columns.starts, columns.tops, columns.shape[1]
    cost = np.full(len(tops), 1 << 30, np.int64)
    heap = [(np.int64(0), np.int64(0), np.int64(0))]  # climb so far, surface, storey of the one before
    heap.clear()
    for source in np.flatnonzero(sources):
        cost[source] = 0
        heappush(heap, (np.int64(0), np.int64(source), np.int64(max(storey[source], 0))))
    is_done = np.zeros(len(tops), np.bool_)
    rest = 0
    while True:
        while heap:
            so_far, n, wanted = heappop(heap)
            if is_done[n]:
                continue
            is_done[n] = True
            if storey[n] == _NONE:
                storey[n] = _free_storey(starts, column_of[n], n, storey, wanted)
            for reach in (1, limits.gap + 1):
                level_surfaces = 0
                low_y, high_y, low_x, high_x = around(column_of[n], reach, columns.shape)
                for y in range(low_y, high_y):
                    for m in range(starts[y * width + low_x], starts[y * width + high_x]):  # a row of columns
                        climb = abs(tops[m] - tops[n])
                        level_surfaces += climb <= limits.step
                        if climb <= limits.step and so_far + climb < cost[m]:
                            cost[m] = so_far + climb
                            heappush(heap, (cost[m], np.int64(m), np.int64(storey[n])))
                if level_surfaces == 9:  # floor all around, itself included
                    break
        while rest < len(tops) and is_done[rest]:
            rest += 1
        if rest == len(tops):
            return
        heappush(heap, (np.int64(0), np.int64(rest), np.int64(0)))


@njit(cache=True, nogil=True)
def _free_storey(starts: Indices, column: int, surface: int, storey: NDArray[np.int32], wanted: int) -> int:
    """Return the wanted storey, or the next that no other surface of the column has."""
    taken = True
    while taken:
        taken = False
        for m in range(starts[column], starts[column + 1]):
            if m != surface and storey[m] == wanted:
                taken = True
        wanted += taken
    return wanted


@njit(cache=True, nogil=True)
def _extend(columns: Columns, column_of: Indices, step: int, reach: int, own: Mask) -> None:
    """Add the surfaces that up to a number of steps lead to, in columns where the storey has none."""
    starts, tops, width = columns.starts, columns.tops, columns.shape[1]
    taken = np.zeros(len(starts) - 1, np.bool_)
    queue = np.empty(len(tops), np.int64)
    count = done = 0
    for n in range(len(tops)):
        if own[n]:
            taken[column_of[n]] = True
            queue[count] = n
            count += 1
    end = count
    for _ in range(reach):
        while done < end:
            n = queue[done]
            done += 1
            low_y, high_y, low_x, high_x = around(column_of[n], 1, columns.shape)
            for y in range(low_y, high_y):
                for x in range(low_x, high_x):
                    at = y * width + x
                    if taken[at]:
                        continue
                    for m in range(starts[at], starts[at + 1]):
                        if not own[m] and abs(tops[m] - tops[n]) <= step:
                            own[m] = taken[at] = True
                            queue[count] = m
                            count += 1
                            break
        end = count
