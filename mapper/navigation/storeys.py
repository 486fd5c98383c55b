"""Storeys of a floor, each with one height a column; ramps and stairs belong to both that they join."""

from heapq import heappop, heappush
from itertools import combinations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.navigation.flood import Indices, Limits, Mask, around
from mapper.navigation.floor import Floor
from mapper.octree.columns import NOWHERE, Columns, starts_of

Heights = NDArray[np.int32]

_LEAST_AREA_M2 = 1.0
_OVERLAP_M = 3.0
_NONE = -1


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

    def extended(own: Mask) -> Heights:
        _extend(columns, column_of, limits.step, reach, own)
        heights = np.full(columns.shape, NOWHERE, np.int32)
        heights.ravel()[column_of[own]] = tops[own]
        return heights

    pairs = combinations(kept, 2) if with_links else ()
    borders = [_border(columns, column_of, limits, storey, pair) for pair in pairs]
    links = [extended(border) for border in borders if border.any()]
    return [extended(storey == number) for number in kept], links


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
