"""Shortest paths: A* over free cells (Hart, Nilsson & Raphael 1968), and their shortening by lines of sight.

The search has 8 neighbours in a plane and 26 in space.
"""

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array, path_length
from mapper.core.voxel_grid import DIAGONAL
from mapper.navigation.distance import DistanceField, Distances, interpolate_at

Cell = tuple[int, int, int]
Cells = NDArray[np.int64]

_START = 255  # in the table of steps: the start of the search
_UNREACHED = 254
_ROOT_2 = np.sqrt(2.0)
_SAMPLES_PER_CELL = 4
_GAIN = 1e-4  # of the length: a round that shortens by less is the last
_MOST_POINTS = 4000
_STEEPEST = DIAGONAL  # slope of a trilinear mix of distances that differ by at most 1 between neighbours
_LEAST_STEP = 0.2  # cells, where a line's clearance is just the radius


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Result of a search.

    Attributes:
        cells: (N, 3) z, y, x from the start to the goal, or to the reachable cell nearest to it.
        reached: Whether the last cell is the goal.
    """

    cells: Cells
    reached: bool


def shortest_path(free: NDArray[np.bool_], start: Cell, goal: Cell) -> SearchResult:
    """Return a shortest path over the centres of free cells; the cost of a step is its Euclidean length.

    A diagonal step needs all cells that it touches to be free, so that the line between two centres lies in
    free cells.

    Args:
        free: (Z, Y, X); a plane is (1, H, W).
        start: A free z, y, x.
        goal: A free z, y, x.
    """
    padding = tuple((0, 0) if n == 1 else (1, 1) for n in free.shape)  # walls, so that steps need no test
    walled = np.pad(free, padding)
    shift = np.array([before for before, _ in padding])
    begin, end = (_flat(np.add(cell, shift), walled.shape) for cell in (start, goal))
    moves, lengths, touched = _moves(walled.shape)
    shape = np.array(walled.shape)
    steps, last = _search(walled.ravel(), shape, begin, end, moves, lengths, touched)
    flat = _backtrack(steps, moves, last)
    cells = np.column_stack(np.unravel_index(flat, walled.shape)).astype(np.int64) - shift
    return SearchResult(cells, reached=bool(last == end))


def _flat(cell: NDArray[np.int64], shape: tuple[int, ...]) -> int:
    return int((cell[0] * shape[1] + cell[1]) * shape[2] + cell[2])


def _moves(shape: tuple[int, ...]) -> tuple[Cells, Array, Cells]:
    """Return every step as (K,) change of a flat index, (K,) length and (K, 6) changes to touched cells.

    The cells that a step touches between its two ends are padded with the end itself.
    """
    reaches = [range(1) if n == 1 else range(-1, 2) for n in shape]
    moves, lengths, touched = [], [], []
    for step in product(*reaches):
        if not any(step):
            continue
        corners = [
            _flat(np.array(c), shape) for c in product(*({0, d} for d in step)) if any(c) and c != step
        ]
        moves.append(_flat(np.array(step), shape))
        lengths.append(float(np.linalg.norm(step)))
        touched.append(sorted(corners) + [moves[-1]] * (6 - len(corners)))
    return np.array(moves), np.array(lengths), np.array(touched)


@njit(cache=True, nogil=True)
def _search(
    free: NDArray[np.bool_], shape: Cells, start: int, goal: int, moves: Cells, lengths: Array, touched: Cells
) -> tuple[NDArray[np.uint8], int]:
    """Return the number of the move into each cell, and the goal or the reachable cell nearest to it."""
    cost = np.full(len(free), np.inf)
    steps = np.full(len(free), _UNREACHED, np.uint8)
    keys, heap, count = np.empty(1024), np.empty(1024, np.int64), 0
    goal_z, goal_y, goal_x = _unflat(goal, shape)
    cost[start], steps[start] = 0.0, _START
    keys, heap, count = _push(keys, heap, count, 0.0, start)
    nearest, nearest_square = start, np.inf
    done = np.zeros(len(free), np.bool_)
    while count > 0:
        cell = heap[0]
        count = _pop(keys, heap, count)
        if done[cell]:
            continue
        done[cell] = True
        if cell == goal:
            return steps, goal
        z, y, x = _unflat(cell, shape)
        square = (z - goal_z) ** 2 + (y - goal_y) ** 2 + (x - goal_x) ** 2
        if square < nearest_square:
            nearest, nearest_square = cell, square
        for k in range(len(moves)):
            other = cell + moves[k]
            if not free[other] or done[other]:
                continue
            through = cost[cell] + lengths[k]
            if through >= cost[other]:
                continue
            clear = True
            for j in range(6):
                clear &= free[cell + touched[k, j]]
            if not clear:
                continue
            cost[other], steps[other] = through, k
            z, y, x = _unflat(other, shape)
            ahead = _octile(abs(z - goal_z), abs(y - goal_y), abs(x - goal_x))
            keys, heap, count = _push(keys, heap, count, through + ahead, other)
    return steps, nearest


@njit(cache=True, nogil=True)
def _octile(a: int, b: int, c: int) -> float:
    """Return the length of a shortest path over this many cells along each axis without obstacles."""
    longest, shortest = max(a, b, c), min(a, b, c)
    middle = a + b + c - longest - shortest
    return float(DIAGONAL * shortest + _ROOT_2 * (middle - shortest) + (longest - middle))


@njit(cache=True, nogil=True, inline="always")
def _unflat(index: int, shape: Cells) -> tuple[int, int, int]:
    row = index // shape[2]
    return row // shape[1], row % shape[1], index % shape[2]


@njit(cache=True, nogil=True)
def _push(keys: Array, heap: Cells, count: int, key: float, item: int) -> tuple[Array, Cells, int]:
    """Add an item to a binary heap; return the heap, enlarged if it was full."""
    if count == len(keys):
        keys = np.concatenate((keys, np.empty_like(keys)))
        heap = np.concatenate((heap, np.empty_like(heap)))
    hole = count
    while hole > 0:
        above = (hole - 1) >> 1
        if keys[above] <= key:
            break
        keys[hole], heap[hole] = keys[above], heap[above]
        hole = above
    keys[hole], heap[hole] = key, item
    return keys, heap, count + 1


@njit(cache=True, nogil=True)
def _pop(keys: Array, heap: Cells, count: int) -> int:
    """Remove the smallest item; return the number of those left."""
    count -= 1
    key, item = keys[count], heap[count]
    hole = 0
    while True:
        below = 2 * hole + 1
        if below >= count:
            break
        if below + 1 < count and keys[below + 1] < keys[below]:
            below += 1
        if keys[below] >= key:
            break
        keys[hole], heap[hole] = keys[below], heap[below]
        hole = below
    keys[hole], heap[hole] = key, item
    return count


@njit(cache=True, nogil=True)
def _backtrack(steps: NDArray[np.uint8], moves: Cells, last: int) -> Cells:
    """Return the flat indices from the start to a reached cell."""
    count, cell = 1, last
    while steps[cell] != _START:
        cell -= moves[steps[cell]]
        count += 1
    path = np.empty(count, np.int64)
    cell = last
    for n in range(count - 1, -1, -1):
        path[n] = cell
        if n > 0:
            cell -= moves[steps[cell]]
    return path


def shorten(field: DistanceField, path: Array, *, radius_m: float) -> Array:
    """Return a shortened path: the same ends, with the clearance kept, never longer.

    Each round puts points every cell along the path and connects each to the farthest point in sight, from
    either end in turn, until a round shortens the path by less than 10⁻⁴.

    Args:
        field: Distances to obstacles.
        path: (N, 3) z, y, x in cells; cell [0, 0, 0] spans 0 … 1. Each segment has the clearance.
        radius_m: The clearance.

    Returns:
        (M, 3) corners.
    """
    best = _corners(field, path, radius_m)
    while True:
        length = path_length(best)
        forth = _corners(field, _sample(best), radius_m)
        back = _corners(field, _sample(forth)[::-1], radius_m)[::-1]
        best = min(best, forth, back, key=path_length)
        if path_length(best) >= (1.0 - _GAIN) * length:
            return best


def in_sight(field: DistanceField, begin: Array, end: Array, *, radius_m: float) -> bool:
    """Return whether a line has a clearance of ``radius_m`` all along.

    Args:
        field: Distances to obstacles.
        begin: (3,) z, y, x in cells.
        end: (3,) z, y, x in cells.
        radius_m: The clearance.
    """
    return bool(_visible(field.distances_m, field.resolution_m, radius_m, begin, end))


def _sample(path: Array) -> Array:
    """Return points about a cell apart along a path, its corners included."""
    spacing = max(1.0, path_length(path) / _MOST_POINTS)
    parts = []
    for begin, end in pairwise(path):
        count = max(1, int(np.ceil(np.linalg.norm(end - begin) / spacing)))
        parts.append(begin + (end - begin) * (np.arange(count) / count)[:, np.newaxis])
    return np.vstack([*parts, path[-1:]])


def _corners(field: DistanceField, path: Array, radius_m: float) -> Array:
    kept = _anchors(field.distances_m, field.resolution_m, radius_m, np.ascontiguousarray(path))
    corners: Array = path[kept]
    return corners


@njit(cache=True, nogil=True)
def _anchors(distances: Distances, resolution_m: float, radius_m: float, path: Array) -> NDArray[np.int64]:
    """Return the indices of a path's points that are joined by straight lines with the clearance."""
    kept = np.empty(len(path), np.int64)
    kept[0], count, anchor = 0, 1, 0
    while anchor < len(path) - 1:
        ahead, stride, grows = anchor + 1, 1, True
        while stride > 0:  # doubled while points are in sight, then halved: testing each is quadratic
            further = min(ahead + stride, len(path) - 1)
            if further > ahead and _visible(distances, resolution_m, radius_m, path[anchor], path[further]):
                ahead = further
            else:
                grows = False
            stride = stride * 2 if grows else stride // 2
        kept[count] = anchor = ahead
        count += 1
    return kept[:count]


@njit(cache=True, nogil=True)
def _visible(distances: Distances, resolution_m: float, radius_m: float, begin: Array, end: Array) -> bool:
    """Return whether a line has the clearance, by steps as long as the distance allows (Hart 1996)."""
    dz, dy, dx = end[0] - begin[0], end[1] - begin[1], end[2] - begin[2]
    length = np.sqrt(dz * dz + dy * dy + dx * dx)
    done = 0.0
    while True:
        share = min(done / length, 1.0) if length > 0.0 else 1.0
        z, y, x = begin[0] + share * dz, begin[1] + share * dy, begin[2] + share * dx
        slack_m = interpolate_at(distances, z, y, x) - radius_m
        if slack_m < 0.0:
            return False
        if share == 1.0:
            return True
        done += max(slack_m / resolution_m / _STEEPEST, _LEAST_STEP)


def clearance_of(field: DistanceField, path_world: Array) -> float:
    """Return the least distance to blocked space along a path, at four points per cell."""
    spacing_m = field.resolution_m / _SAMPLES_PER_CELL
    lowest_m = np.inf
    for begin, end in pairwise(path_world):
        count = int(np.ceil(np.linalg.norm(end - begin) / spacing_m)) + 1
        points = begin + (end - begin) * np.linspace(0.0, 1.0, count)[:, np.newaxis]
        lowest_m = min(lowest_m, float(field.distance(points).min()))
    return lowest_m
