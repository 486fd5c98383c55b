"""Cells of occupancy grids by position."""

import numpy as np

from mapper.octree.grid import OccupancyGrid


def state_at(grid: OccupancyGrid, x_m: float, y_m: float) -> int:
    """Return the state of the cell at a point of the world."""
    column, row = np.floor((np.array([x_m, y_m]) - grid.origin_world_m) / grid.resolution_m).astype(int)
    return int(grid.cells[row, column])
