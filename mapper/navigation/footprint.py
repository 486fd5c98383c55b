"""Footprint of what carried the sensor: ground that it swept along the path, where it was not seen too."""

import numpy as np
from numba import njit

from mapper.core.geometry import Array
from mapper.navigation.flood import Indices, Limits, Mask
from mapper.navigation.path_ground import PathGround
from mapper.octree.columns import NOWHERE, Columns, Tops
from mapper.octree.keys import KEY_ZERO

_NEAR_GROUND_M = 0.25


def with_footprint(
    columns: Columns, path: PathGround, limits: Limits, *, radius_m: float
) -> tuple[Columns, Mask]:
    """Return the columns with a voxel wherever ground of the path was not seen, and a mask of that ground.

    A column under the footprint has the ground of the path unless an obstacle lower than the sensor or,
    outside the path's own column, a drop was measured there. What is higher than the sensor did not stop what
    carried it.

    Args:
        columns: The map's occupied voxels.
        path: Ground along the path.
        limits: Limits of the robot.
        radius_m: Radius of the footprint.
    """
    if not len(path):
        return columns, np.zeros(len(columns.tops), np.bool_)
    cell_m = columns.resolution_m
    places = path.points_world[:, :2] / cell_m - (columns.first - KEY_ZERO)
    heights = path.points_world[:, 2] / cell_m
    rooms = np.minimum(np.rint(path.sensor_m / cell_m).astype(np.int64), limits.room)
    near = max(limits.step, round(_NEAR_GROUND_M / cell_m))
    column, top = _swept(columns, places, heights, rooms, radius_m / cell_m, limits.step, near)
    if not len(column):  # obstacles everywhere below the path
        return columns, np.zeros(len(columns.tops), np.bool_)
    keys = np.unique((column << 17) | (top + KEY_ZERO))
    column, top = keys >> 17, (keys & (1 << 17) - 1) - KEY_ZERO
    # A column comes at several heights where the path climbs; of those of a storey the middle one counts.
    new = np.flatnonzero(np.concatenate([[True], (np.diff(column) > 0) | (np.diff(top) > limits.room)]))
    middle = (new + np.append(new[1:], len(keys)) - 1) // 2
    column, top = column[middle], top[middle].astype(np.int32)
    columns = columns.with_tops(column, top)
    return columns, _with_tops(columns, column, top)


@njit(cache=True, nogil=True)
def _swept(
    columns: Columns,
    places: Array,
    heights: Array,
    rooms: Indices,
    radius: float,
    step: int,
    near: int,
) -> tuple[Indices, Indices]:
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
def _ground_in(
    columns: Columns, column: int, height: float, limits: tuple[int, int, int], crosses_drops: bool
) -> int:
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
def _with_tops(columns: Columns, wanted: Indices, tops: Tops) -> Mask:
    """Return the mask of the voxels with some tops, each in its column."""
    found = np.zeros(len(columns.tops), np.bool_)
    for i in range(len(wanted)):
        for n in range(columns.starts[wanted[i]], columns.starts[wanted[i] + 1]):
            found[n] |= columns.tops[n] == tops[i]
    return found
