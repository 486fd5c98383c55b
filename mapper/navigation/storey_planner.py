"""Paths over several storeys of a floor, from one to the next where they share ramps and stairs."""

from collections import deque
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import PlanError
from mapper.core.geometry import Array, path_length
from mapper.navigation.config import PlanConfig
from mapper.navigation.line_of_sight import shortened
from mapper.navigation.planner import Plan, Space, clearance_of, point_text, space_of
from mapper.navigation.search import shortest_path
from mapper.navigation.traversable import Storey, TraversableFloor
from mapper.navigation.voxels import layer
from mapper.octree.columns import NOWHERE, nearest_heights
from mapper.octree.grid import UNKNOWN, OccupancyGrid


def plan_storeys(
    floor: TraversableFloor, start_world: Array, goal_world: Array, *, config: PlanConfig
) -> Plan:
    """Return a shortest path for a disc over the storeys of a floor; see ``plan_2d``.

    The path changes storeys, the fewest that join the two, over the links between them, or else where both
    have the same floor. An end without a height is on the storey where the log begins, or else on the lowest
    with floor there.

    Args:
        floor: Floor from :func:`mapper.navigation.traversable.traversable`, with links.
        start_world: (2,) or (3,) metres.
        goal_world: (2,) or (3,) metres.
        config: Radius, and whether unknown cells are blocked.

    Returns:
        A plan whose waypoints have the height of the floor.

    Raises:
        PlanError: An end is outside, unknown or too close to an obstacle, or no path joins the two.
    """
    parts = (*floor.storeys, *floor.links)  # numbered in this order from here on
    joined, heights = _aligned(parts)
    spaces = [space_of(layer(grid), config) for grid in joined]
    ends = [np.append(point[:2], 0.0) for point in (start_world, goal_world)]
    numbers = [_storey_at(floor, point) for point in (start_world, goal_world)]
    is_link = [number >= len(floor.storeys) for number in range(len(parts))]
    layers = [_with_room(floor, spaces, *at) for at in zip(numbers, (start_world, goal_world), strict=True)]
    chain = _chain(spaces, heights, is_link, *layers)
    if not chain:
        raise PlanError(
            f"no ramp or stairs lead from the storey of {point_text(start_world)} to that of "
            f"{point_text(goal_world)} for a radius of {config.radius_m:g} m; plan with a smaller radius"
        )
    first, last = spaces[chain[0]], spaces[chain[-1]]
    start, goal = first.cell(ends[0], "start"), last.cell(ends[1], "goal")
    planes = [spaces[chain[0]].free[0]]
    for below, above in pairwise(chain):  # between storeys a plane of what they share
        planes += [_shared(spaces, heights, below, above), spaces[above].free[0]]
    found = shortest_path(np.array(planes), start, (2 * (len(chain) - 1), *goal[1:]))
    if not found.reached:
        raise PlanError(
            f"no path from {point_text(start_world)} to {point_text(goal_world)} over "
            f"{len(chain) - sum(is_link[number] for number in chain)} storeys "
            f"for a radius of {config.radius_m:g} m; plan with a smaller radius"
        )
    cells = found.cells.astype(np.float64) + 0.5
    legs: list[Array] = [cells[found.cells[:, 0] == 2 * place, 1:] for place in range(len(chain))]
    legs[0] = np.vstack([first.in_cells(ends[0])[1:], legs[0]])
    legs[-1] = np.vstack([legs[-1], last.in_cells(ends[1])[1:]])
    on_floors = [
        _on_floor(spaces[number], heights[number], leg) for number, leg in zip(chain, legs, strict=True)
    ]
    waypoints_world = np.concatenate([part_world for part_world, _ in on_floors])
    clearance_m = min(clearance_m for _, clearance_m in on_floors)
    visited = dict.fromkeys((numbers[0], *(number for number in chain if not is_link[number]), numbers[1]))
    length_m = path_length(waypoints_world)
    return Plan(waypoints_world, length_m, clearance_m, config, storeys=tuple(visited))


def _aligned(storeys: tuple[Storey, ...]) -> tuple[list[OccupancyGrid], list[NDArray[np.int32]]]:
    """Return the grids and heights of some storeys in one raster; heights with a ring like ``layer``."""
    cell_m = storeys[0].grid.resolution_m
    firsts = np.array([np.rint(storey.grid.origin_world_m / cell_m) for storey in storeys], np.int64)
    sizes = np.array([storey.grid.cells.shape[::-1] for storey in storeys])
    low, high = firsts.min(axis=0), (firsts + sizes).max(axis=0)
    grids, heights = [], []
    for storey, first in zip(storeys, firsts, strict=True):
        x, y = first - low
        rows, columns = storey.grid.cells.shape
        cells = np.full((high - low)[::-1], UNKNOWN, np.int8)
        cells[y : y + rows, x : x + columns] = storey.grid.cells
        tops = np.full((high - low)[::-1] + 2, NOWHERE, np.int32)
        tops[y + 1 : y + 1 + rows, x + 1 : x + 1 + columns] = storey.heights
        grids.append(OccupancyGrid(cells, low * cell_m, cell_m))
        heights.append(tops)
    return grids, heights


def _on_floor(space: Space, heights: NDArray[np.int32], cells: Array) -> tuple[Array, float]:
    """Return waypoints on a storey's floor through (N, 2) rows and columns, and their clearance."""
    cells = np.column_stack([np.full(len(cells), 0.5), cells])
    part_world = space.world(shortened(space.field, cells, radius_m=space.least_m))
    clearance_m = clearance_of(space.field, part_world)
    at = np.floor(np.array([space.in_cells(point) for point in part_world])[:, 1:]).astype(np.int64)
    tops, _ = nearest_heights(heights)  # closed gaps have the height of the floor around them
    part_world[:, 2] = tops[at[:, 0], at[:, 1]] * space.field.resolution_m
    return part_world, clearance_m


def _storey_at(floor: TraversableFloor, point_world: Array) -> int:
    """Return the storey of a point: that whose floor is nearest to its height, if it has one."""
    tops, home = [_top_at(storey, point_world) for storey in floor.storeys], floor.home_number
    if len(point_world) == 2:
        order = sorted(range(len(tops)), key=lambda number: number != home)
        return next((number for number in order if tops[number] is not None), home)
    away = [np.inf if top is None else abs(top - float(point_world[2])) for top in tops]
    return int(np.argmin(away)) if np.isfinite(away).any() else home


def _with_room(floor: TraversableFloor, spaces: list[Space], number: int, point_world: Array) -> int:
    """Return a storey, or where a robot has room on a link alone, as at the storey's end, the link."""
    top_m = _top_at(floor.storeys[number], point_world)
    if top_m is None or _has_room(spaces[number], point_world):
        return number
    for link, storey in enumerate(floor.links, start=len(floor.storeys)):
        if _top_at(storey, point_world) == top_m and _has_room(spaces[link], point_world):
            return link
    return number


def _has_room(space: Space, point_world: Array) -> bool:
    try:
        space.cell(np.append(point_world[:2], 0.0), "start")
    except PlanError:
        return False
    return True


def _top_at(storey: Storey, point_world: Array) -> float | None:
    """Return the height of a storey's floor at a point, metres; None if it has none there."""
    grid = storey.grid
    column, row = np.floor((point_world[:2] - grid.origin_world_m) / grid.resolution_m).astype(int)
    inside = 0 <= row < grid.cells.shape[0] and 0 <= column < grid.cells.shape[1]
    if not inside or storey.heights[row, column] == NOWHERE:
        return None
    return float(storey.heights[row, column]) * grid.resolution_m


def _shared(spaces: list[Space], heights: list[NDArray[np.int32]], one: int, other: int) -> Array:
    """Return the mask of the cells whose floor belongs to both of two storeys, with room for the robot."""
    same = (heights[one] == heights[other]) & (heights[one] != NOWHERE)
    mask: Array = same & spaces[one].free[0] & spaces[other].free[0]
    return mask


def _chain(
    spaces: list[Space], heights: list[NDArray[np.int32]], is_link: list[bool], start: int, goal: int
) -> list[int]:
    """Return the fewest storeys, and the links between them, that lead from one to another.

    Storeys that no links join may share floor themselves; an empty list if nothing joins the two.
    """
    before, queue = {start: start}, deque([start])
    for needs_link in (True, False):
        queue.extend(before if not needs_link else ())
        while queue and goal not in before:
            here = queue.popleft()
            for other in range(len(spaces)):
                can_join = other not in before and is_link[here] + is_link[other] >= needs_link
                if can_join and _shared(spaces, heights, here, other).any():
                    before[other] = here
                    queue.append(other)
    if goal not in before:
        return []
    chain = [goal]
    while chain[-1] != start:
        chain.append(before[chain[-1]])
    return chain[::-1]
