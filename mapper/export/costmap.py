"""Costmap for nav2's planners and controllers: the inflated slice as files that its map_server loads."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.export.grid import write_values
from mapper.export.palette import FREE_CELL, OCCUPIED_CELL, UNKNOWN_CELL
from mapper.navigation.distance import plane_distances
from mapper.octree.grid import OCCUPIED, UNKNOWN, OccupancyGrid, with_obstacles
from mapper.run.map_folder import MapFolder
from mapper.runtime.atomic import write_bytes
from mapper.runtime.progress import Progress

NO_INFORMATION, LETHAL, INSCRIBED, FREE_SPACE = 255, 254, 253, 0
"""nav2_costmap_2d's cost values."""

_MOST_INFLATED = 98
_INSCRIBED, _LETHAL, _UNKNOWN = 99, 100, 255
_PICTURE_PX_PER_CELL = 4


def costmap(run: MapFolder, path: Path, _progress: Progress) -> None:
    """Write YAML in map_server's mode "raw" with PGM and PNG beside it.

    Raises:
        DataError: The configured radii do not fit together.
    """
    config = run.config.costmap
    grid = with_obstacles(run.slice, run.keepout)
    costs = inflate(
        grid,
        robot_radius_m=config.robot_radius_m,
        inflation_radius_m=config.inflation_radius_m,
        cost_scaling=config.cost_scaling,
    )
    values = occupancy_values(costs)
    write_bytes(path.with_suffix(".png"), _picture(values))
    write_values(path.parent, path.stem, values, grid)


def inflate(
    grid: OccupancyGrid, *, robot_radius_m: float, inflation_radius_m: float, cost_scaling: float
) -> NDArray[np.uint8]:
    """Return the (H, W) uint8 costs of nav2's static and inflation layers for a grid.

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
    return costs


def occupancy_values(costs: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return costs as nav2 publishes them: 0 free, 1 … 98, 99 inscribed, 100 lethal, 255 unknown."""
    table = np.zeros(256, np.uint8)
    inflated = np.arange(1, INSCRIBED)
    table[1:INSCRIBED] = 1 + (_MOST_INFLATED - 1) * (inflated - 1) // (INSCRIBED - 2)
    table[[INSCRIBED, LETHAL, NO_INFORMATION]] = _INSCRIBED, _LETHAL, _UNKNOWN
    return table[costs]


def _picture(values: NDArray[np.uint8]) -> bytes:
    """Return a PNG: redder with the cost, obstacles dark, unknown grey."""
    share = np.clip(values, 0, _INSCRIBED).astype(np.float32)[..., None] / _INSCRIBED
    bgr = (1.0 - share) * FREE_CELL[::-1] + share * (40.0, 60.0, 225.0)
    bgr[values == _LETHAL] = OCCUPIED_CELL[::-1]
    bgr[values == _UNKNOWN] = UNKNOWN_CELL[::-1]
    enlarged = np.kron(bgr[::-1].astype(np.uint8), np.ones((_PICTURE_PX_PER_CELL,) * 2 + (1,), np.uint8))
    _, encoded = cv2.imencode(".png", enlarged)
    return encoded.tobytes()
