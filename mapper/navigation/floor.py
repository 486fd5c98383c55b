"""Floor that a robot can reach from where it was driven, on every storey: steps, slopes and head room."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Points
from mapper.navigation.config import TraversableConfig
from mapper.navigation.flood import (
    OFF_PLANE,
    Limits,
    Mask,
    find_on_plane,
    find_steep,
    find_surfaces,
    flood,
    limits_of,
)
from mapper.navigation.footprint import with_footprint
from mapper.navigation.path_ground import PathGround, joined, path_ground
from mapper.octree.columns import NOWHERE, Columns, DrivenGround, occupied_columns
from mapper.octree.map import OctreeMap


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
    return floor_of(columns, config, paths_world=[positions_world])


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
    path = joined(
        path_ground(
            columns,
            positions_world,
            radius_m=config.footprint_m,
            room_m=config.head_room_m,
            floor_z_m=floor_z_m,
        )
        for positions_world in paths_world
    )
    columns, driven = with_footprint(columns, path, limits, radius_m=config.footprint_m)
    is_surface = find_surfaces(columns, limits.room) | driven
    seeds = np.flatnonzero(driven)
    if not len(seeds):
        floor = floor_z_m / columns.resolution_m
        # A floor at z = 0 lies in the voxel above or in that below.
        seeds = np.flatnonzero(is_surface & (np.abs(columns.tops - floor) <= limits.step))
    around = columns, columns.column_of.astype(np.int32), limits
    by_steps = flood(*around, seeds, is_surface)
    steep = find_steep(*around, by_steps) & ~driven
    seeds = seeds[~steep[seeds]]
    reached = flood(*around, seeds, by_steps & ~steep)
    # Where floor meets a steep bank, the plane through both is too steep for what still is floor. And a slope
    # that the path led over, such as stairs, is one that can be taken across its width.
    others = by_steps & ~reached
    level = find_on_plane(*around, others, reached, (0.0, limits.slope), OFF_PLANE)
    stairs = find_on_plane(*around, others, driven, (limits.slope, np.inf), OFF_PLANE + limits.step / 2.0)
    reached = flood(*around, seeds, reached | level | stairs)
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
