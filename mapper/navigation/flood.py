"""Surfaces of columns of voxels that steps connect, and the planes through them."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.navigation.config import TraversableConfig
from mapper.octree.columns import Tops

_ALLOWANCE = 1e-6  # of a voxel: 0.1 m is two voxels of 5 cm, whatever the rounding of the division
OFF_PLANE = 0.75
"""Of a voxel: rounding to voxels moves a surface by half of one."""
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
    step = max(1, int(config.max_step_m / cell_m + _ALLOWANCE))
    slope = float(np.tan(config.max_slope_rad))
    # The plane through a step in the middle of n columns rises by 1.5 / n of it.
    least_window = int(np.ceil((1.5 * step / slope - 1.0) / 2.0 - _ALLOWANCE))
    return Limits(
        step=step,
        room=int(np.ceil(config.head_room_m / cell_m - _ALLOWANCE)),
        gap=int(config.max_gap_m / cell_m + _ALLOWANCE),
        window=max(least_window, round((config.slope_window_m / cell_m - 1.0) / 2.0), 1),
        least_window=max(least_window, 1),
        slope=slope,
    )


@njit(cache=True, nogil=True)
def mark_surfaces(starts: Indices, tops: Tops, room: int, marked: Mask) -> None:
    """Mark the voxels with at least ``room`` free voxels above."""
    for column in range(len(starts) - 1):
        end = starts[column + 1]
        for n in range(starts[column], end):
            marked[n] = n + 1 == end or tops[n + 1] - tops[n] > room


@njit(cache=True, nogil=True)
def flood(
    starts: Indices,
    tops: Tops,
    shape: tuple[int, int],
    column_of: NDArray[np.int32],
    limits: Limits,
    seeds: Indices,
    open_: Mask,
    reached: Mask,
) -> None:
    """Mark the open surfaces that steps connect to the seeds, over gaps where no neighbour does.

    Args:
        starts: As in ``Columns``.
        tops: As in ``Columns``, (N,).
        shape: H, W.
        column_of: (N,) number of each voxel's column.
        limits: Of the robot.
        seeds: Indices of the voxels to begin at.
        open_: (N,) mask of the voxels whose tops may be entered.
        reached: (N,) result.
    """
    height, width = shape
    total = 0
    for n in range(len(tops)):
        total += open_[n]
    queue, gaps = np.empty(total, np.int32), np.empty(total, np.int32)
    count = done = gap_count = gap_done = 0
    for n in seeds:
        if open_[n] and not reached[n]:
            reached[n] = True
            queue[count] = n
            count += 1
    reach = limits.gap + 1
    while True:
        while done < count:
            here = queue[done]
            done += 1
            row, column = column_of[here] // width, column_of[here] % width
            is_edge = False
            for y in range(row - 1, row + 2):
                for x in range(column - 1, column + 2):
                    if y == row and x == column:
                        continue
                    found = -1
                    if 0 <= y < height and 0 <= x < width:
                        found = _within_step(starts, tops, y * width + x, tops[here], limits.step, open_)
                    if found < 0:
                        is_edge = True
                    elif not reached[found]:
                        reached[found] = True
                        queue[count] = found
                        count += 1
            if is_edge and reach > 1:
                gaps[gap_count] = here
                gap_count += 1
        if gap_done == gap_count:
            return
        here = gaps[gap_done]
        gap_done += 1
        row, column = column_of[here] // width, column_of[here] % width
        for y in range(max(row - reach, 0), min(row + reach + 1, height)):
            for x in range(max(column - reach, 0), min(column + reach + 1, width)):
                found = _within_step(starts, tops, y * width + x, tops[here], limits.step, open_)
                if (
                    found >= 0
                    and not reached[found]
                    and _nothing_between(starts, tops, width, row, column, y, x, tops[here], limits)
                ):
                    reached[found] = True
                    queue[count] = found
                    count += 1


@njit(cache=True, nogil=True)
def _within_step(starts: Indices, tops: Tops, column: int, top: int, step: int, open_: Mask) -> int:
    """Return the open surface of a column that is nearest to a height and within a step of it, or −1."""
    found = -1
    for n in range(starts[column], starts[column + 1]):
        away = abs(tops[n] - top)
        if open_[n] and away <= step and (found < 0 or away < abs(tops[found] - top)):
            found = n
    return found


@njit(cache=True, nogil=True)
def _nothing_between(
    starts: Indices, tops: Tops, width: int, row: int, column: int, y: int, x: int, top: int, limits: Limits
) -> bool:
    """Return whether the columns on the line between two hold neither an obstacle nor a drop."""
    parts = max(abs(y - row), abs(x - column))
    for part in range(1, parts):
        v = row + int(np.rint((y - row) * part / parts))
        u = column + int(np.rint((x - column) * part / parts))
        if _is_blocked(starts, tops, v * width + u, top, limits):
            return False
    return True


@njit(cache=True, nogil=True)
def _is_blocked(starts: Indices, tops: Tops, column: int, top: int, limits: Limits) -> bool:
    """Return whether a column holds an obstacle above a floor's height, or lies more than a step below."""
    for n in range(starts[column], starts[column + 1]):
        rise = tops[n] - top
        if -limits.room <= rise < -limits.step or limits.step < rise <= limits.room:
            return True
    return False


@njit(cache=True, nogil=True)
def _plane(
    starts: Indices,
    tops: Tops,
    shape: tuple[int, int],
    place: tuple[int, int, int],
    window: int,
    limits: Limits,
    used: Mask,
) -> tuple[float, float, float]:
    """Return the least-squares plane through the floor around: height above ``top``, rises along x and y.

    Floor that is too much higher or lower for any slope that the robot can take is left out: it is another
    storey. Where the floor is a single line or point, the plane is level along it.
    """
    height, width = shape
    row, column, top = place
    stride = max(1, window // _SAMPLES)
    count = sx = sy = sz = sxx = syy = sxy = sxz = syz = 0.0
    for dy in range(-(window // stride) * stride, window + 1, stride):
        for dx in range(-(window // stride) * stride, window + 1, stride):
            y, x = row + dy, column + dx
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
def mark_steep(
    starts: Indices,
    tops: Tops,
    shape: tuple[int, int],
    column_of: NDArray[np.int32],
    limits: Limits,
    candidates: Mask,
    marked: Mask,
) -> None:
    """Mark the candidates around which the plane through all of them is too steep, in either window."""
    for n in range(len(tops)):
        if candidates[n]:
            place = (column_of[n] // shape[1], column_of[n] % shape[1], tops[n])
            for window in (limits.least_window, limits.window):
                _, a, b = _plane(starts, tops, shape, place, window, limits, candidates)
                marked[n] |= np.sqrt(a * a + b * b) > limits.slope


@njit(cache=True, nogil=True)
def mark_plane(
    starts: Indices,
    tops: Tops,
    shape: tuple[int, int],
    column_of: NDArray[np.int32],
    limits: Limits,
    candidates: Mask,
    floor: Mask,
    slopes: tuple[float, float],
    tolerance: float,
    marked: Mask,
) -> None:
    """Mark the candidates that lie in the plane of the floor next to them.

    Args:
        starts: As in ``Columns``.
        tops: As in ``Columns``, (N,).
        shape: H, W.
        column_of: (N,) number of each voxel's column.
        limits: Of the robot.
        candidates: (N,) mask of the voxels to look at.
        floor: (N,) mask of the voxels that planes are laid through.
        slopes: Least and largest slope of the plane, rise over run.
        tolerance: Largest distance from the plane, in voxels.
        marked: (N,) result.
    """
    height, width = shape
    for n in range(len(tops)):
        if not candidates[n]:
            continue
        row, column = column_of[n] // width, column_of[n] % width
        is_at_floor = False
        for y in range(max(row - limits.window, 0), min(row + limits.window + 1, height)):
            for x in range(max(column - limits.window, 0), min(column + limits.window + 1, width)):
                if (
                    not is_at_floor
                    and _within_step(starts, tops, y * width + x, tops[n], limits.step, floor) >= 0
                ):
                    is_at_floor = True
        if is_at_floor:
            place = (row, column, tops[n])
            above, a, b = _plane(starts, tops, shape, place, limits.window, limits, floor)
            slope = np.sqrt(a * a + b * b)
            marked[n] |= abs(above) <= tolerance and slopes[0] <= slope <= slopes[1]
