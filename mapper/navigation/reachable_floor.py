"""Floor that a robot can reach from where it was driven, on every storey: steps, slopes and head room.

The ground under a trajectory, where what carried the sensor stood or rolled, is where it begins; what its
footprint swept is floor, too, where it was not seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Array, Points
from mapper.navigation import floor_kernels as kernels
from mapper.navigation.config import TraversableConfig
from mapper.navigation.floor_kernels import OFF_PLANE, Limits, Mask, limits_of
from mapper.octree.keys import KEY_ZERO
from mapper.octree.map import OctreeMap
from mapper.octree.occupied_columns import NOWHERE, Columns, DrivenGround, occupied_columns, starts_of

MAX_SENSOR_HEIGHT_M = 4.0
"""Sensors are carried no higher than this above the ground."""
_CHANGE_PER_M = 10.0
"""A change of the sensor's height by a metre costs as much as this number of samples without ground below."""
_LONGEST_STEPS = 5.0
_CARRIED_M = 0.3  # height of a path over a layer, where only its x and y count
_STRETCH_M = 2.0
"""Length of a step, whatever is usual, that breaks a path, and of a stretch that was travelled along."""
_STEADY_M = 0.3
"""Heights that differ by less are the same ground's."""


@dataclass(frozen=True, slots=True, eq=False)
class PathGround:
    """Ground along a path.

    Attributes:
        points_world: (N, 3) metres: x and y of the sensor, z of the ground below it; a voxel apart at most.
        sensor_m: (N,) height of the sensor above it.
    """

    points_world: Points
    sensor_m: Array

    def __len__(self) -> int:
        return len(self.points_world)


def join_paths(paths: Sequence[PathGround]) -> PathGround:
    """Return the ground along several paths, one after the other; there is at least one."""
    return PathGround(
        np.concatenate([path.points_world for path in paths]),
        np.concatenate([path.sensor_m for path in paths]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """Surfaces of the map, and those that were reached.

    Attributes:
        columns: The map's occupied voxels, and one for each place of the path whose ground was not seen.
        reached: (N,) mask of the voxels whose tops are floor.
        steep: (N,) mask of those that steps alone would reach.
        driven: (N,) mask of the floor under the path.
        path: The path's ground.
        limits: Limits of the robot.
    """

    columns: Columns
    reached: Mask
    steep: Mask
    driven: Mask
    path: PathGround
    limits: Limits


def reachable_floor(octree: OctreeMap, config: TraversableConfig, *, positions_world: Points) -> Floor:
    """Return the floor of a run's map that a robot can reach from the ground under a path; see ``floor_of``.

    Args:
        octree: The map in a world with z up and the floor at 0.
        config: Limits of the robot.
        positions_world: (N, 3) of the sensor, in the order in which it passed.

    Raises:
        DataError: The map is empty.
    """
    if not len(octree):
        raise DataError("traversable floor: the map is empty; fuse scans into it first")
    columns = occupied_columns(octree, margin=margin_for(config, octree.resolution_m))
    if config.floor == "layer":
        columns = _as_a_layer(columns, octree, limits_of(config, columns.resolution_m).step)
        positions_world = positions_world * [1.0, 1.0, 0.0] + [0.0, 0.0, _CARRIED_M]
    return floor_of(columns, config, paths_world=[positions_world])


def _as_a_layer(columns: Columns, octree: OctreeMap, step: int) -> Columns:
    """Return columns with floor at z = 0 where voxels are free, and an obstacle where any is occupied."""
    tops = np.full(columns.shape, NOWHERE, np.int32)
    for known in octree.leaves_by_part():
        x, y, _ = known.keys.T.astype(np.int64)
        height = np.where(known.log_odds >= octree.occupied_log_odds, step + 1, 0)
        np.maximum.at(tops, (y - columns.first[1], x - columns.first[0]), height.astype(np.int32))
    known_columns = np.flatnonzero(tops.ravel() > NOWHERE)
    starts = starts_of(known_columns, tops.size)
    return columns._replace(starts=starts, tops=tops.ravel()[known_columns])


def margin_for(config: TraversableConfig, resolution_m: float) -> int:
    """Return the columns that are needed around a map: what carried a sensor may have begun outside it."""
    return int(np.ceil(config.footprint_m / resolution_m))


def floor_of(
    columns: Columns, config: TraversableConfig, *, paths_world: Sequence[Points], floor_z_m: float = 0.0
) -> Floor:
    """Return the floor that a robot can reach from the ground under some paths.

    A surface is the top of an occupied voxel with head room above it, where unknown voxels count as free.
    From the ground under the paths, steps lead from surface to surface, over gaps in which nothing is known.
    Surfaces on which the plane through the floor around is too steep are not entered, unless a path led over
    them. Without a path whose ground is known, all surfaces at the floor's height are where it begins.

    Args:
        columns: The map's occupied voxels, with a margin of ``margin_for``; z is up.
        config: Limits of the robot.
        paths_world: (N, 3) positions of the sensor in every log, in the order in which it passed.
        floor_z_m: Height of the floor in the world.
    """
    limits = limits_of(config, columns.resolution_m)
    settings = {"radius_m": config.footprint_m, "room_m": config.head_room_m, "floor_z_m": floor_z_m}
    path = join_paths([path_ground(columns, path_world, **settings) for path_world in paths_world])
    columns, driven = add_footprint(columns, path, limits, radius_m=config.footprint_m)
    is_surface = kernels.find_surfaces(columns, limits.room) | driven
    seeds = np.flatnonzero(driven)
    if not len(seeds):
        floor = floor_z_m / columns.resolution_m
        # A floor at z = 0 lies in the voxel above or in that below.
        seeds = np.flatnonzero(is_surface & (np.abs(columns.tops - floor) <= limits.step))
    around = columns, columns.column_of.astype(np.int32), limits
    by_steps = kernels.flood(*around, seeds, is_surface)
    steep = kernels.find_steep(*around, by_steps) & ~driven
    seeds = seeds[~steep[seeds]]
    reached = kernels.flood(*around, seeds, by_steps & ~steep)
    # Where floor meets a steep bank, the plane through both is too steep for what still is floor. And a slope
    # that the path led over, such as stairs, is one that can be taken across its width.
    others = by_steps & ~reached
    level = kernels.find_on_plane(*around, others, reached, (0.0, limits.slope), OFF_PLANE)
    stairs = kernels.find_on_plane(
        *around, others, driven, (limits.slope, np.inf), OFF_PLANE + limits.step / 2.0
    )
    reached = kernels.flood(*around, seeds, reached | level | stairs)
    return Floor(columns, reached, by_steps & ~reached, driven, path, limits)


def driven_ground(floor: Floor) -> DrivenGround:
    """Return the lowest floor of every column, and what the footprint passed over."""
    columns, column_of = floor.columns, floor.columns.column_of
    heights = np.full(columns.shape, NOWHERE, np.int32)
    at = column_of[floor.reached][::-1]  # the lowest of a column comes last
    heights.ravel()[at] = columns.tops[floor.reached][::-1]
    swept = np.zeros(columns.shape, np.bool_)
    swept.ravel()[column_of[floor.driven & floor.reached]] = True
    return DrivenGround(heights, swept, columns.first)


def path_ground(
    columns: Columns, positions_world: Points, *, radius_m: float, room_m: float, floor_z_m: float
) -> PathGround:
    """Return the ground along a path, as far as it is the ground that was driven or walked on.

    Below each point of the path the map's surfaces within a radius vote for heights of the sensor above the
    ground; the sequence of heights with the most votes and the least change is found by dynamic programming
    (Viterbi 1967). So a surface that is seen now and then gives the height where none is seen, and a table
    that a camera is held over does not raise the ground of a walk. A stretch is left out if its height is not
    that of the others and its ground, away from the floor's height, was not travelled along: a camera that
    never leaves a desk shows nothing of the floor.

    Args:
        columns: The map's occupied voxels.
        positions_world: (N, 3) of the sensor, in the order in which it passed.
        radius_m: Half the width of what carried it.
        room_m: Free height that a surface needs above it, unless the sensor is lower.
        floor_z_m: Height of the floor in the world.
    """
    cell_m = columns.resolution_m
    points, breaks = _sample(positions_world, cell_m)
    highest = int(np.ceil(MAX_SENSOR_HEIGHT_M / cell_m))
    low = (points[:, :2] / cell_m - (columns.first - KEY_ZERO)).astype(np.float64)
    votes = _vote_heights(columns, low, points[:, 2] / cell_m, radius_m / cell_m, room_m / cell_m, highest)
    height = _find_steadiest(votes, _CHANGE_PER_M * cell_m)
    seen = votes[np.arange(len(points)), height] > 0.0
    ground = points - np.column_stack([np.zeros((len(points), 2)), height * cell_m])
    kept = _mask_driven(ground, height * cell_m, seen, breaks, floor_z_m)
    return PathGround(ground[kept], height[kept] * cell_m)


def _sample(positions_world: Points, spacing_m: float) -> tuple[Points, NDArray[np.int64]]:
    """Return points along the path, a spacing apart at most, and the first point after each break of it."""
    if len(positions_world) < 2:
        return positions_world.copy(), np.empty(0, np.int64)
    steps_m = np.linalg.norm(np.diff(positions_world, axis=0), axis=1)
    moving = steps_m[steps_m > 1e-3]
    longest_m = max(_STRETCH_M, _LONGEST_STEPS * float(np.median(moving))) if len(moving) else 0.0
    pieces, breaks, count = [positions_world[:1]], [], 1
    last = positions_world[0]
    for position, step_m in zip(positions_world[1:], steps_m, strict=True):
        if step_m > longest_m:
            breaks.append(count)
            parts = 1
        else:
            away_m = float(np.linalg.norm(position - last))
            if away_m < 0.5 * spacing_m:
                continue
            parts = int(np.ceil(away_m / spacing_m))
        shares = np.arange(1, parts + 1)[:, np.newaxis] / parts
        pieces.append(last + shares * (position - last) if parts > 1 else position[np.newaxis])
        last, count = position, count + parts
    return np.concatenate(pieces), np.array(breaks, np.int64)


def _mask_driven(
    ground: Points, sensor_m: Array, seen: NDArray[np.bool_], breaks: NDArray[np.int64], floor_z_m: float
) -> NDArray[np.bool_]:
    """Return a mask of the points whose stretch of the path was driven or walked along."""
    jumps = np.flatnonzero(np.abs(np.diff(sensor_m)) > _STEADY_M) + 1
    bounds = np.unique(np.concatenate([[0], jumps, breaks, [len(ground)]]))
    kept = np.zeros(len(ground), np.bool_)
    usual: list[float] = []
    stretches = sorted(pairwise(bounds.tolist()), key=lambda one: one[0] - one[1])
    for first, last in stretches:  # the longest first: its height is the usual one
        extent_m = float(np.linalg.norm(np.ptp(ground[first:last], axis=0)))
        on_floor = np.abs(ground[first:last, 2] - floor_z_m)[seen[first:last]] < _STEADY_M
        height_m = float(np.median(sensor_m[first:last]))
        is_usual = any(abs(height_m - one) <= _STEADY_M for one in usual)
        if not seen[first:last].any() and not is_usual:
            continue
        if is_usual or on_floor.mean() > 0.5 or (not usual and extent_m >= _STRETCH_M):
            kept[first:last] = True
            usual.append(height_m)
    return kept


def add_footprint(
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
    near = max(limits.step, round(_STEADY_M / cell_m))
    column, top = kernels.find_swept(columns, places, heights, rooms, radius_m / cell_m, limits.step, near)
    if not len(column):  # obstacles everywhere below the path
        return columns, np.zeros(len(columns.tops), np.bool_)
    keys = np.unique((column << 17) | (top + KEY_ZERO))
    column, top = keys >> 17, (keys & (1 << 17) - 1) - KEY_ZERO
    # A column comes at several heights where the path climbs; of those of a storey the middle one counts.
    new = np.flatnonzero(np.concatenate([[True], (np.diff(column) > 0) | (np.diff(top) > limits.room)]))
    middle = (new + np.append(new[1:], len(keys)) - 1) // 2
    column, top = column[middle], top[middle].astype(np.int32)
    columns = columns.with_tops(column, top)
    return columns, kernels.mask_tops(columns, column, top)


@njit(cache=True, nogil=True)
def _vote_heights(
    columns: Columns, places: Array, sensor_z: Array, radius: float, room: float, highest: int
) -> NDArray[np.float32]:
    """Return, for each height of the sensor, the share of the columns around with a surface that far below.

    Args:
        columns: The map's occupied voxels.
        places: (N, 2) x and y in columns.
        sensor_z: (N,) heights in voxels.
        radius: Distance from each place, in columns.
        room: Number of free voxels that a surface needs above it, at most up to the sensor.
        highest: Largest height of the sensor above the ground, in voxels.

    Returns:
        (N, highest + 1) shares, 0 … 1.
    """
    starts, tops = columns.starts, columns.tops
    height, width = columns.shape
    votes = np.zeros((len(places), highest + 1), np.float32)
    for i in range(len(places)):
        x, y = places[i]
        count = 0
        for row in range(int(np.floor(y - radius)), int(np.floor(y + radius)) + 1):
            for column in range(int(np.floor(x - radius)), int(np.floor(x + radius)) + 1):
                if (row + 0.5 - y) ** 2 + (column + 0.5 - x) ** 2 > radius * radius and not (
                    row == int(np.floor(y)) and column == int(np.floor(x))
                ):
                    continue
                count += 1
                if not (0 <= row < height and 0 <= column < width):
                    continue
                at = row * width + column
                for n in range(starts[at], starts[at + 1]):
                    below = sensor_z[i] - tops[n]
                    if below < 1.0 or below > highest:
                        continue
                    if n + 1 < starts[at + 1] and tops[n + 1] - tops[n] <= min(room, below):
                        continue
                    votes[i, int(np.rint(below))] += 1.0
        for k in range(highest + 1):
            votes[i, k] /= count
    return votes


@njit(cache=True, nogil=True)
def _find_steadiest(votes: NDArray[np.float32], change_cost: float) -> NDArray[np.int64]:
    """Return the (N,) heights of least cost: 1 − votes for a height and its neighbours, plus changes."""
    count, states = votes.shape
    came_from = np.empty((count, states), np.int16)
    cost = np.zeros(states)
    best, source = np.empty(states), np.empty(states, np.int16)
    for i in range(count):
        for k in range(states):  # the distance transform of the costs so far: least cost plus change
            best[k], source[k] = cost[k], k
        for k in range(1, states):
            if best[k - 1] + change_cost < best[k]:
                best[k], source[k] = best[k - 1] + change_cost, source[k - 1]
        for k in range(states - 2, -1, -1):
            if best[k + 1] + change_cost < best[k]:
                best[k], source[k] = best[k + 1] + change_cost, source[k + 1]
        for k in range(states):
            share = votes[i, k]
            if k > 0:
                share += 0.5 * votes[i, k - 1]
            if k + 1 < states:
                share += 0.5 * votes[i, k + 1]
            cost[k] = best[k] + 1.0 - min(1.0, share)
            came_from[i, k] = source[k]
    heights = np.empty(count, np.int64)
    state = int(np.argmin(cost))
    for i in range(count - 1, -1, -1):
        heights[i] = state
        state = came_from[i, state]
    return heights
