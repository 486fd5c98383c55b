"""Compiled steps of the floor: surfaces that steps connect, planes through them, and a path's footprint."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.navigation.config import TraversableConfig
from mapper.octree.occupied_columns import NOWHERE

ALLOWANCE = 1e-6  # of a voxel: 0.1 m is two voxels of 5 cm, whatever the rounding of the division
OFF_PLANE = 0.75
"""Largest distance of floor from its plane, in voxels: rounding to voxels moves a surface by half of one."""
_SAMPLES = 4  # of a slope's window, on each side

Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]


class Limits(NamedTuple):
    """Limits of the robot, in voxels.

    Attributes:
        step: Largest difference of heights between neighbours, at least 1.
        room: Number of voxels above a surface that must not be occupied.
        gap: Number of columns between neighbours, at most.
        window: Number of columns of the slope's window on each side.
        least_window: The same of the smallest window in which a single step is not too steep.
        slope: Largest rise over run.
    """

    step: int
    room: int
    gap: int
    window: int
    least_window: int
    slope: float


def limits_of(config: TraversableConfig, cell_m: float) -> Limits:
    """Return the limits of a robot in a map with voxels of an edge of ``cell_m``.

    A step lower than a voxel cannot be distinguished from noise and counts as one voxel.
    """
    step = max(1, int(config.max_step_m / cell_m + ALLOWANCE))
    slope = float(np.tan(config.max_slope_rad))
    # The plane through a step in the middle of n columns rises by 1.5 / n of it.
    least_window = int(np.ceil((1.5 * step / slope - 1.0) / 2.0 - ALLOWANCE))
    return Limits(
        step=step,
        room=int(np.ceil(config.head_room_m / cell_m - ALLOWANCE)),
        gap=int(config.max_gap_m / cell_m + ALLOWANCE),
        window=max(least_window, round((config.slope_window_m / cell_m - 1.0) / 2.0), 1),
        least_window=max(least_window, 1),
        slope=slope,
    )


@njit(cache=True, nogil=True)
def find_surfaces(columns, room):
    """Return the (N,) mask of the voxels with at least ``room`` free voxels above."""
    starts, tops = columns.starts, columns.tops
    found = np.zeros(len(tops), np.bool_)
    for column in range(len(starts) - 1):
        end = starts[column + 1]
        for n in range(starts[column], end):
            found[n] = n + 1 == end or tops[n + 1] - tops[n] > room
    return found


@njit(cache=True, nogil=True)
def flood(columns, column_of, limits, seeds, open_):
    """Return the mask of the open surfaces that steps connect to the seeds, over gaps without a neighbour.

    Args:
        columns: The occupied voxels, of which there are N.
        column_of: (N,) number of each voxel's column.
        limits: Limits of the robot.
        seeds: Indices of the voxels to begin at.
        open_: (N,) mask of the voxels whose tops may be entered.
    """
    total = 0
    for n in range(len(open_)):
        total += open_[n]
    reached = np.zeros(len(open_), np.bool_)
    queue, edges = np.empty(total, np.int32), np.empty(total, np.int32)
    count = done = edge_count = edges_done = 0
    for n in seeds:
        if open_[n] and not reached[n]:
            reached[n] = True
            queue[count] = n
            count += 1
    while True:
        while done < count:
            here = queue[done]
            done += 1
            found, is_edge = _enter_neighbours(
                columns, column_of[here], here, limits, open_, reached, queue[count:]
            )
            count += found
            if is_edge and limits.gap > 0:
                edges[edge_count] = here
                edge_count += 1
        if edges_done == edge_count:
            return reached
        here = edges[edges_done]
        edges_done += 1
        count += _cross_gaps(columns, column_of[here], here, limits, open_, reached, queue[count:])


@njit(cache=True, nogil=True)
def _enter_neighbours(columns, column, here, limits, open_, reached, entered):
    """Enter the surfaces a step away in the eight columns around.

    Returns:
        Number of surfaces that are written to ``entered``, and whether any of the columns has none.
    """
    starts, tops = columns.starts, columns.tops
    height, width = columns.shape
    row, x_here = column // width, column % width
    count, is_edge = 0, False
    for y in range(row - 1, row + 2):
        for x in range(x_here - 1, x_here + 2):
            if y == row and x == x_here:
                continue
            found = -1
            if 0 <= y < height and 0 <= x < width:
                found = _within_step(starts, tops, y * width + x, tops[here], limits.step, open_)
            if found < 0:
                is_edge = True
            elif not reached[found]:
                reached[found] = True
                entered[count] = found
                count += 1
    return count, is_edge


@njit(cache=True, nogil=True)
def _cross_gaps(columns, column, here, limits, open_, reached, entered):
    """Enter the surfaces a step away beyond a gap in which nothing is known; return their number."""
    starts, tops, width = columns.starts, columns.tops, columns.shape[1]
    low_y, high_y, low_x, high_x = around(column, limits.gap + 1, columns.shape)
    count = 0
    for y in range(low_y, high_y):
        for at in range(y * width + low_x, y * width + high_x):
            found = _within_step(starts, tops, at, tops[here], limits.step, open_)
            is_new = found >= 0 and not reached[found]
            if is_new and _nothing_between(columns, column, at, tops[here], limits):
                reached[found] = True
                entered[count] = found
                count += 1
    return count


@njit(cache=True, nogil=True)
def around(column, reach, shape):
    """Return the ranges, as first and end, of the rows and of the columns within a reach of a column."""
    height, width = shape
    y, x = column // width, column % width
    return max(y - reach, 0), min(y + reach + 1, height), max(x - reach, 0), min(x + reach + 1, width)


@njit(cache=True, nogil=True)
def _within_step(starts, tops, column, top, step, open_):
    """Return the open surface of a column that is nearest to a height and within a step of it, or −1.

    This is called so often that it takes arrays: numba counts references to those it takes from a tuple.
    """
    found = -1
    for n in range(starts[column], starts[column + 1]):
        away = abs(tops[n] - top)
        if open_[n] and away <= step and (found < 0 or away < abs(tops[found] - top)):
            found = n
    return found


@njit(cache=True, nogil=True)
def _nothing_between(columns, begin, end, top, limits):
    """Return whether the columns on the line between two hold neither an obstacle nor a drop."""
    width = columns.shape[1]
    y, x = begin // width, begin % width
    rows, across = end // width - y, end % width - x
    parts = max(abs(rows), abs(across))
    for part in range(1, parts):
        v = y + int(np.rint(rows * part / parts))
        u = x + int(np.rint(across * part / parts))
        if _is_blocked(columns, v * width + u, top, limits):
            return False
    return True


@njit(cache=True, nogil=True)
def _is_blocked(columns, column, top, limits):
    """Return whether a column holds an obstacle above a floor's height, or lies more than a step below."""
    for n in range(columns.starts[column], columns.starts[column + 1]):
        rise = columns.tops[n] - top
        if -limits.room <= rise < -limits.step or limits.step < rise <= limits.room:
            return True
    return False


@njit(cache=True, nogil=True)
def _plane(columns, column, top, window, limits, used):
    """Return the least-squares plane through the floor around: height above ``top``, rises along x and y.

    Floor that is too much higher or lower for any slope that the robot can take is left out: it is another
    storey. Where the floor is a single line or point, the plane is level along it.
    """
    starts, tops = columns.starts, columns.tops
    height, width = columns.shape
    row, x_here = column // width, column % width
    stride = max(1, window // _SAMPLES)
    count = sx = sy = sz = sxx = syy = sxy = sxz = syz = 0.0
    for dy in range(-(window // stride) * stride, window + 1, stride):
        for dx in range(-(window // stride) * stride, window + 1, stride):
            y, x = row + dy, x_here + dx
            if not (0 <= y < height and 0 <= x < width):
                continue
            most = limits.step + 2.0 * limits.slope * np.sqrt(dx * dx + dy * dy)
            nearest = most + 1.0
            for n in range(starts[y * width + x], starts[y * width + x + 1]):
                if used[n] and abs(tops[n] - top) < abs(nearest):
                    nearest = float(tops[n] - top)
            if abs(nearest) > most:
                continue
            count += 1.0
            sx, sy, sz = sx + dx, sy + dy, sz + nearest
            sxx, syy, sxy = sxx + dx * dx, syy + dy * dy, sxy + dx * dy
            sxz, syz = sxz + dx * nearest, syz + dy * nearest
    if count == 0.0:
        return 0.0, 0.0, 0.0
    # Moments about the mean, times count², so that all of these sums are whole numbers.
    cxx, cyy, cxy = count * sxx - sx * sx, count * syy - sy * sy, count * sxy - sx * sy
    cxz, cyz = count * sxz - sx * sz, count * syz - sy * sz
    determinant = cxx * cyy - cxy * cxy
    if determinant <= 0.0:
        return sz / count, 0.0, 0.0
    a, b = (cyy * cxz - cxy * cyz) / determinant, (cxx * cyz - cxy * cxz) / determinant
    return (sz - a * sx - b * sy) / count, a, b


@njit(cache=True, nogil=True)
def find_steep(columns, column_of, limits, candidates):
    """Return the mask of the candidates around which their plane is too steep, in either window."""
    found = np.zeros(len(candidates), np.bool_)
    for n in range(len(candidates)):
        if candidates[n]:
            for window in (limits.least_window, limits.window):
                _, a, b = _plane(columns, column_of[n], columns.tops[n], window, limits, candidates)
                found[n] |= np.sqrt(a * a + b * b) > limits.slope
    return found


@njit(cache=True, nogil=True)
def find_on_plane(columns, column_of, limits, candidates, floor, slopes, tolerance):
    """Return the mask of the candidates that lie in the plane of the floor next to them.

    Args:
        columns: The occupied voxels, of which there are N.
        column_of: (N,) number of each voxel's column.
        limits: Limits of the robot.
        candidates: (N,) mask of the voxels to look at.
        floor: (N,) mask of the voxels to which planes are fitted.
        slopes: Least and largest slope of the plane, rise over run.
        tolerance: Largest distance from the plane, in voxels.
    """
    found = np.zeros(len(candidates), np.bool_)
    for n in range(len(candidates)):
        column, top = column_of[n], columns.tops[n]
        if candidates[n] and _is_at_floor(columns, column, top, limits, floor):
            above, a, b = _plane(columns, column, top, limits.window, limits, floor)
            slope = np.sqrt(a * a + b * b)
            found[n] = abs(above) <= tolerance and slopes[0] <= slope <= slopes[1]
    return found


@njit(cache=True, nogil=True)
def _is_at_floor(columns, column, top, limits, floor):
    """Return whether floor lies within a step of a height in any column of the slope's window."""
    low_y, high_y, low_x, high_x = around(column, limits.window, columns.shape)
    starts, tops, width = columns.starts, columns.tops, columns.shape[1]
    for y in range(low_y, high_y):
        for at in range(y * width + low_x, y * width + high_x):
            if _within_step(starts, tops, at, top, limits.step, floor) >= 0:
                return True
    return False


@njit(cache=True, nogil=True)
def find_swept(columns, places, heights, rooms, radius, step, near):
    """Return the columns within a radius of the path and the ground in each, as often as passed.

    Args:
        columns: The map's occupied voxels.
        places: (N, 2) x and y of the path in columns.
        heights: (N,) height of the ground in voxels.
        rooms: (N,) number of voxels above the ground in which an obstacle blocks.
        radius: Radius of the footprint, in columns.
        step: Largest step of the robot, in voxels.
        near: A surface within this distance of the path's ground, in the path's own column, is that ground.
    """
    height, width = columns.shape
    passed, found = [], []
    for i in range(len(places)):
        x, y = places[i]
        for row in range(int(np.floor(y - radius)), int(np.floor(y + radius)) + 1):
            for column in range(int(np.floor(x - radius)), int(np.floor(x + radius)) + 1):
                if not (0 <= row < height and 0 <= column < width):
                    continue
                aside_x = max(column - x, 0.0, x - column - 1)
                aside_y = max(row - y, 0.0, y - row - 1)
                is_own = aside_x == 0.0 and aside_y == 0.0
                if not is_own and aside_x * aside_x + aside_y * aside_y >= radius * radius:
                    continue
                limits = step, rooms[i], near if is_own else step
                top = _ground_in(columns, row * width + column, heights[i], limits, is_own)
                if top != NOWHERE:
                    passed.append(row * width + column)
                    found.append(top)
    return np.array(passed, dtype=np.int64), np.array(found, dtype=np.int64)


@njit(cache=True, nogil=True)
def _ground_in(columns, column, height, limits, crosses_drops):
    """Return the top of the path's ground in a column, seen or not; NOWHERE if it is blocked."""
    tops, begin, end = columns.tops, columns.starts[column], columns.starts[column + 1]
    best = NOWHERE
    step, room, near = limits
    for n in range(begin, end):
        is_surface = n + 1 == end or tops[n + 1] - tops[n] > room
        away = abs(tops[n] - height)
        if is_surface and away <= near + 0.5 and (best == NOWHERE or away < abs(best - height)):
            best = int(tops[n])
    if best != NOWHERE:
        return best
    for n in range(begin, end):
        rise = tops[n] - height
        if step < rise <= room or (not crosses_drops and -room <= rise < -step):
            return NOWHERE
    return int(np.rint(height))


@njit(cache=True, nogil=True)
def mask_tops(columns, wanted, tops):
    """Return the mask of the voxels with some tops, each in its column."""
    found = np.zeros(len(columns.tops), np.bool_)
    for i in range(len(wanted)):
        for n in range(columns.starts[wanted[i]], columns.starts[wanted[i] + 1]):
            found[n] |= columns.tops[n] == tops[i]
    return found
