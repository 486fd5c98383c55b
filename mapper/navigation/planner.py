"""Path planner: shortest collision-free paths for a disc on a grid, or for a ball in the octree."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import PlanError
from mapper.core.geometry import Array, Points, path_length
from mapper.navigation.config import PlanConfig
from mapper.navigation.distance import DistanceField, distance_field
from mapper.navigation.line_of_sight import in_sight, shortened
from mapper.navigation.search import Cell, shortest_path
from mapper.navigation.voxels import VoxelGrid, cut_box, known_box, layer
from mapper.octree.grid import OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.map import OctreeMap

_BYTES_PER_VOXEL = 30  # a distance field's 14, the mask of free voxels, and the search's costs and steps
_ROUNDING_M = 1e-6
_SAMPLES_PER_CELL = 4


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
    return _planned(layer(grid), ends[0], ends[1], config)


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
    voxels = cut_box(octree, known_box(octree), bytes_per_voxel=_BYTES_PER_VOXEL)
    if keep_out is not None:
        _block(voxels, keep_out)
    return _planned(voxels, np.asarray(start_world, np.float64), np.asarray(goal_world, np.float64), config)


def _block(voxels: VoxelGrid, keep_out: Callable[[Points], NDArray[np.bool_]]) -> None:
    """Mark the voxels as occupied whose centres are kept out of, a layer at a time."""
    for z, states in enumerate(voxels.states):
        y, x = np.nonzero(states != OCCUPIED)
        centres = np.column_stack([x, y, np.full(len(x), z)]) + 0.5
        blocked = keep_out(voxels.corner_world_m + centres * voxels.resolution_m)
        states[y[blocked], x[blocked]] = OCCUPIED


def _planned(voxels: VoxelGrid, start_world: Array, goal_world: Array, config: PlanConfig) -> Plan:
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
    waypoints_world = space.world(shortened(space.field, path, radius_m=space.least_m))
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
        return self.config.radius_m - _ROUNDING_M

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
    return Space(voxels, field, field.distances_m >= config.radius_m - _ROUNDING_M, config)


def _or_unknown(config: PlanConfig) -> str:
    return ", or let unknown space count as free" if config.unknown == "blocked" else ""


def clearance_of(field: DistanceField, path_world: Array) -> float:
    """Return the least distance to blocked space along a path, at four points per cell."""
    spacing_m = field.resolution_m / _SAMPLES_PER_CELL
    lowest_m = np.inf
    for begin, end in pairwise(path_world):
        count = int(np.ceil(np.linalg.norm(end - begin) / spacing_m)) + 1
        points = begin + (end - begin) * np.linspace(0.0, 1.0, count)[:, np.newaxis]
        lowest_m = min(lowest_m, float(field.distance(points).min()))
    return lowest_m
