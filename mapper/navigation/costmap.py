"""Inflated costmap for the planners and controllers of nav2."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Array
from mapper.navigation.distance import plane_distances
from mapper.octree.grid import OCCUPIED, UNKNOWN, OccupancyGrid

NO_INFORMATION, LETHAL, INSCRIBED, FREE_SPACE = 255, 254, 253, 0
"""nav2_costmap_2d's cost values."""


@dataclass(frozen=True, slots=True, eq=False)
class Costmap:
    """Costs of the robot's centre being in a cell.

    Attributes:
        costs: (H, W) uint8 costs of nav2; row 0 has the lowest y, column 0 the lowest x.
        origin_world_m: (2,) x and y of the lower left corner of cell (0, 0), metres.
        resolution_m: Edge of a cell.
    """

    costs: NDArray[np.uint8]
    origin_world_m: Array
    resolution_m: float


def inflate(
    grid: OccupancyGrid, *, robot_radius_m: float, inflation_radius_m: float, cost_scaling: float
) -> Costmap:
    """Return the costs of nav2's static and inflation layers for a grid.

    With d from a cell's centre to that of the nearest obstacle: 254 on obstacles, 253 up to the robot's
    radius r, then 252·exp(−s·(d − r)) up to the inflation radius, rounded up to whole cells as nav2 does;
    0 beyond. Unknown cells stay 255 unless a robot in them would touch an obstacle.

    Args:
        grid: The slice or the floor.
        robot_radius_m: r, the inscribed radius; 0 is a point.
        inflation_radius_m: Distance up to which there are costs; at least r.
        cost_scaling: Decay of the cost with distance, s, 1/m.

    Raises:
        DataError: A radius or the scaling is negative or not finite, or the inflation ends inside the robot.
    """
    for name, value in (("robot radius", robot_radius_m), ("cost scaling", cost_scaling)):
        if not 0.0 <= value < np.inf:
            raise DataError(f"costmap: {name} {value}; want a finite number ≥ 0")
    if not robot_radius_m <= inflation_radius_m < np.inf:
        raise DataError(
            f"costmap: inflation radius {inflation_radius_m} m, want at least the robot's {robot_radius_m} m"
        )
    cells = plane_distances(grid.cells == OCCUPIED)
    distances_m = cells * grid.resolution_m
    decay = np.exp(-cost_scaling * np.maximum(distances_m - robot_radius_m, 0.0))
    costs = ((INSCRIBED - 1) * decay).astype(np.uint8)
    costs[distances_m <= robot_radius_m] = INSCRIBED
    costs[cells > np.ceil(inflation_radius_m / grid.resolution_m)] = FREE_SPACE
    costs[grid.cells == OCCUPIED] = LETHAL
    costs[(grid.cells == UNKNOWN) & (costs < INSCRIBED)] = NO_INFORMATION
    return Costmap(costs, grid.origin_world_m, grid.resolution_m)
