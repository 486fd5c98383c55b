"""Path planner: shortest collision-free paths for a disc on a grid or on storeys, or a ball in the octree."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import PlanError
from mapper.core.geometry import Array, Points, path_length
from mapper.navigation.config import PlanConfig
from mapper.navigation.distance import DistanceField, VoxelGrid, dense_voxels, distance_field, layer
from mapper.navigation.floor_kernels import ALLOWANCE
from mapper.navigation.path_search import Cell, clearance_of, in_sight, shorten, shortest_path
from mapper.navigation.traversable_grid import Storey, TraversableFloor
from mapper.octree.grid import OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.map import OctreeMap
from mapper.octree.occupied_columns import NOWHERE, nearest_heights

_BYTES_PER_VOXEL = 30  # a distance field's 14, the mask of free voxels, and the search's costs and steps


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A path.

    Attributes:
        waypoints_world: (N, D) metres, D = 2 on a grid and 3 in the octree, from start to goal.
        length_m: Length of the straight lines between them.
        min_clearance_m: Least distance of the path to blocked space; +inf if there is none.
        config: Settings of the plan.
        storeys: Numbers of the storeys that it leads over, in order, if the floor has several.
    """

    waypoints_world: Array
    length_m: float
    min_clearance_m: float
    config: PlanConfig
    storeys: tuple[int, ...] = ()

    @property
    def dimensions(self) -> int:
        """2 or 3."""
        return int(self.waypoints_world.shape[1])

    @property
    def map_name(self) -> str:
        """Map that it was planned on: "octree", "slice" or "traversable"."""
        return "octree" if self.dimensions == 3 and not self.storeys else self.config.layer

    @property
    def summary(self) -> str:
        """The path in one line of text."""
        config = self.config
        where = f"the {self.map_name}"
        if self.storeys:
            where += f" of {' to '.join(f'storey {number}' for number in self.storeys)}"
        return (
            f"{self.length_m:.2f} m in {where}, {len(self.waypoints_world)} waypoints, "
            f"{self.min_clearance_m:.2f} m clear at the narrowest; radius {config.radius_m:g} m, "
            f"unknown {config.unknown}"
        )


def plan_2d(grid: OccupancyGrid, start_world: Array, goal_world: Array, *, config: PlanConfig) -> Plan:
    """Return a shortest path for a disc on a grid; the space around the grid is unknown.

    The distance field, linear between the centres of cells, is at least the radius all along the path. The
    path is never longer than the shortest one over the centres of neighbouring cells (8 in a plane, 26 in
    space) with that clearance: that one is searched by A*, then shortened between the obstacles.

    Args:
        grid: The slice, or the traversable floor.
        start_world: (2,) metres.
        goal_world: (2,) metres.
        config: Radius, and whether unknown cells are blocked.

    Raises:
        PlanError: An end is outside, unknown or too close to an obstacle, or no path joins the two.
    """
    ends = [np.append(np.asarray(point, np.float64), 0.0) for point in (start_world, goal_world)]
    return _plan(layer(grid), ends[0], ends[1], config)


def plan_3d(
    octree: OctreeMap,
    start_world: Array,
    goal_world: Array,
    *,
    config: PlanConfig,
    keep_out: Callable[[Points], NDArray[np.bool_]] | None = None,
) -> Plan:
    """Return a shortest path for a ball through the known part of the octree, as :func:`plan_2d` does.

    Args:
        octree: The map; its floor and ceiling are obstacles like any other.
        start_world: (3,) metres.
        goal_world: (3,) metres.
        config: Radius, and whether unknown voxels are blocked.
        keep_out: Returns which of (N, 3) points, metres, are blocked in addition.

    Raises:
        PlanError: As :func:`plan_2d`.
        MapSizeError: The known part of the map is too large.
    """
    voxels = dense_voxels(octree, bytes_per_voxel=_BYTES_PER_VOXEL)
    if keep_out is not None:
        _block(voxels, keep_out)
    return _plan(voxels, np.asarray(start_world, np.float64), np.asarray(goal_world, np.float64), config)


def _block(voxels: VoxelGrid, keep_out: Callable[[Points], NDArray[np.bool_]]) -> None:
    """Mark the voxels as occupied whose centres are kept out of, a layer at a time."""
    for z, states in enumerate(voxels.states):
        y, x = np.nonzero(states != OCCUPIED)
        centres = np.column_stack([x, y, np.full(len(x), z)]) + 0.5
        blocked = keep_out(voxels.corner_world_m + centres * voxels.resolution_m)
        states[y[blocked], x[blocked]] = OCCUPIED


def _plan(voxels: VoxelGrid, start_world: Array, goal_world: Array, config: PlanConfig) -> Plan:
    space = space_of(voxels, config)
    start, goal = space.cell(start_world, "start"), space.cell(goal_world, "goal")
    found = shortest_path(space.free, start, goal)
    if not found.reached:
        reached_world = space.centre(found.cells[-1])
        raise PlanError(
            f"no path from {space.text(start_world)} to {space.text(goal_world)} for a radius of "
            f"{config.radius_m:g} m; the nearest to the goal that can be reached is "
            f"{space.text(reached_world)}, {np.linalg.norm(goal_world - reached_world):.2f} m from it: go "
            f"there, or plan with a smaller radius{_or_unknown(config)}"
        )
    path = np.vstack([space.in_cells(start_world), found.cells + 0.5, space.in_cells(goal_world)])
    waypoints_world = space.world(shorten(space.field, path, radius_m=space.least_m))
    waypoints_world[[0, -1]] = start_world, goal_world  # to the last digit
    return Plan(
        waypoints_world[:, : space.dimensions],
        path_length(waypoints_world),
        clearance_of(space.field, waypoints_world),
        config,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """Space for the centre of a robot.

    Attributes:
        voxels: The map.
        field: Distances to blocked space.
        free: (Z, Y, X) mask of voxels whose centres have the radius as clearance.
        config: Settings of the plan.
    """

    voxels: VoxelGrid
    field: DistanceField
    free: NDArray[np.bool_]
    config: PlanConfig

    @property
    def dimensions(self) -> int:
        """2 or 3."""
        return 2 if len(self.free) == 1 else 3

    @property
    def least_m(self) -> float:
        """The radius less an allowance for rounding."""
        return self.config.radius_m - ALLOWANCE

    def in_cells(self, point_world: Array) -> Array:
        """Return a point's z, y, x in cells."""
        return ((point_world - self.voxels.corner_world_m) / self.voxels.resolution_m)[::-1]

    def world(self, zyx: Array) -> Array:
        """Return points from their (N, 3) z, y, x in cells."""
        return self.voxels.corner_world_m + zyx[:, ::-1] * self.voxels.resolution_m

    def centre(self, cell: NDArray[np.int64]) -> Array:
        """Return the centre of a cell."""
        centre_world: Array = self.world((cell.astype(np.float64) + 0.5)[np.newaxis])[0]
        return centre_world

    def text(self, point_world: Array) -> str:
        """Return a point as messages write it, with two or three coordinates."""
        return point_text(point_world[: self.dimensions])

    def cell(self, point_world: Array, name: str) -> Cell:
        """Return a free cell whose centre is in the line of sight of one end of the path.

        Raises:
            PlanError: There is none.
        """
        if point_world.shape != (3,) or not np.isfinite(point_world).all():
            raise PlanError(f"the {name} {point_world.tolist()} is no point; want finite coordinates, metres")
        zyx = self.in_cells(point_world)
        z, y, x = (int(n) for n in np.floor(zyx).clip(-1, 2**31))
        if not all(0 <= n < count for n, count in zip((z, y, x), self.free.shape, strict=True)):
            known = np.argwhere(self.voxels.states != UNKNOWN)
            low, high = self.world(np.array([known.min(axis=0), known.max(axis=0) + 1]).astype(np.float64))
            raise PlanError(
                f"the {name} {self.text(point_world)} lies outside the map, which spans {self.text(low)} to "
                f"{self.text(high)} m; {self._nearest(point_world)}"
            )
        clearance_m = float(self.field.distance(point_world[np.newaxis])[0])
        if clearance_m >= self.least_m:
            for cell in self._around(zyx):
                centre = np.array(cell) + 0.5
                if self.free[cell] and in_sight(self.field, zyx, centre, radius_m=self.least_m):
                    return cell
        remedy = self._nearest(point_world)
        if self.voxels.states[z, y, x] == UNKNOWN and self.config.unknown == "blocked":
            raise PlanError(
                f"the {name} {self.text(point_world)} lies in unknown space; {remedy}"
                f"{_or_unknown(self.config)}"
            )
        if clearance_m <= 0.0:
            raise PlanError(f"the {name} {self.text(point_world)} lies in an obstacle; {remedy}")
        raise PlanError(
            f"the {name} {self.text(point_world)} is {clearance_m:.3f} m from what is blocked, too close for "
            f"a radius of {self.config.radius_m:g} m; {remedy}{_or_unknown(self.config)}"
        )

    def _around(self, zyx: Array) -> list[Cell]:
        """Return the cells whose centres surround a position, the nearest first."""
        low = np.floor(zyx - 0.5).astype(np.int64)
        cells = np.array(list(product(*((n, n + 1) for n in low)))).clip(0, np.array(self.free.shape) - 1)
        order = np.argsort(np.linalg.norm(cells + 0.5 - zyx, axis=1), kind="stable")
        return [(int(z), int(y), int(x)) for z, y, x in cells[order]]

    def _nearest(self, point_world: Array) -> str:
        cells = np.argwhere(self.free)
        if not len(cells):
            raise PlanError(
                f"nowhere in the map is there room for a radius of {self.config.radius_m:g} m; plan with a "
                f"smaller one{_or_unknown(self.config)}"
            )
        squares = np.square(cells + 0.5 - self.in_cells(point_world)).sum(axis=1)
        nearest_world = self.centre(cells[int(np.argmin(squares))])
        away_m = float(np.sqrt(squares.min())) * self.voxels.resolution_m
        return f"the nearest free point is {self.text(nearest_world)}, {away_m:.2f} m away"


def point_text(point_world: Array) -> str:
    """Return a point as text, metres to three decimals."""
    return f"({', '.join(f'{value:.3f}' for value in point_world)})"


def space_of(voxels: VoxelGrid, config: PlanConfig) -> Space:
    """Return the space that a map leaves to a robot's centre."""
    field = distance_field(voxels, unknown_blocks=config.unknown == "blocked")
    return Space(voxels, field, field.distances_m >= config.radius_m - ALLOWANCE, config)


def _or_unknown(config: PlanConfig) -> str:
    return ", or let unknown space count as free" if config.unknown == "blocked" else ""


def plan_storeys(
    floor: TraversableFloor, start_world: Array, goal_world: Array, *, config: PlanConfig
) -> Plan:
    """Return a shortest path for a disc over the storeys of a floor; see ``plan_2d``.

    The path changes storeys, the fewest that join the two, over the links between them, or else where both
    have the same floor. An end without a height is on the storey where the log begins, or else on the lowest
    with floor there.

    Args:
        floor: Floor from :func:`mapper.navigation.traversable_grid.traversable`, with links.
        start_world: (2,) or (3,) metres.
        goal_world: (2,) or (3,) metres.
        config: Radius, and whether unknown cells are blocked.

    Returns:
        A plan whose waypoints have the height of the floor.

    Raises:
        PlanError: An end is outside, unknown or too close to an obstacle, or no path joins the two.
    """
    parts = (*floor.storeys, *floor.links)  # numbered in this order from here on
    joined, heights = _align(parts)
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


def _align(storeys: tuple[Storey, ...]) -> tuple[list[OccupancyGrid], list[NDArray[np.int32]]]:
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
    part_world = space.world(shorten(space.field, cells, radius_m=space.least_m))
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
