"""Signed Euclidean distance fields in 2D and 3D: distances to the nearest obstacle."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Array, Points
from mapper.navigation.distance_transform import NONE, squares_to_boxes
from mapper.navigation.voxels import Box, VoxelGrid, cut_box, layer
from mapper.octree.grid import OccupancyGrid
from mapper.octree.map import OctreeMap

Distances = NDArray[np.float32]

_BYTES_PER_VOXEL = 14  # states, blocked, two int32 transforms, the float32 result


@dataclass(frozen=True, slots=True, eq=False)
class DistanceField:
    """Signed distances at the centres of a box's voxels.

    Attributes:
        distances_m: (Z, Y, X) float32 result of :func:`signed_distances`.
        corner_world_m: (3,) lower x, y, z of voxel [0, 0, 0].
        resolution_m: Edge of a voxel.
    """

    distances_m: Distances
    corner_world_m: Array
    resolution_m: float

    def distance(self, points_world: Points) -> Distances:
        """Return (N,) metres at (N, 3) points, trilinear between centres; NaN outside the box.

        Raises:
            DataError: The points are not (N, 3).
        """
        return self._interpolated(points_world)[:, 0]

    def gradient(self, points_world: Points) -> Distances:
        """Return the (N, 3) gradient of that interpolation, which points away from the nearest obstacle.

        Raises:
            DataError: The points are not (N, 3).
        """
        return self._interpolated(points_world)[:, 1:]

    def _interpolated(self, points_world: Points) -> Distances:
        if points_world.ndim != 2 or points_world.shape[1] != 3:
            raise DataError(f"distance field: points {points_world.shape}, want (N, 3)")
        points = np.ascontiguousarray(points_world, dtype=np.float64)
        found: Distances = _interpolate(self.distances_m, self.corner_world_m, self.resolution_m, points)
        return found


def distance_2d(grid: OccupancyGrid, *, unknown_blocks: bool) -> Distances:
    """Return the signed distance of every cell of a grid; the space around the grid is unknown.

    Args:
        grid: The slice or the floor.
        unknown_blocks: Whether unknown cells count as obstacles.

    Returns:
        (H, W) float32 metres as of :func:`signed_distances`; row 0 has the lowest y.
    """
    voxels = layer(grid)
    distances_m = signed_distances(voxels.blocked(unknown_blocks=unknown_blocks), grid.resolution_m)
    return np.ascontiguousarray(distances_m[0, 1:-1, 1:-1])


def distance_3d(octree: OctreeMap, box: Box, *, unknown_blocks: bool) -> DistanceField:
    """Return the distance field of a box of the map; obstacles outside the box do not count.

    Args:
        octree: The map.
        box: Part of the map; larger than the wanted part by the distance of interest.
        unknown_blocks: Whether unknown voxels count as obstacles.

    Raises:
        MapSizeError: More space is needed; nothing has been allocated then.
    """
    voxels = cut_box(octree, box, bytes_per_voxel=_BYTES_PER_VOXEL)
    return distance_field(voxels, unknown_blocks=unknown_blocks)


def distance_field(voxels: VoxelGrid, *, unknown_blocks: bool) -> DistanceField:
    """Return the distance field of a voxel grid."""
    distances_m = signed_distances(voxels.blocked(unknown_blocks=unknown_blocks), voxels.resolution_m)
    return DistanceField(distances_m, voxels.corner_world_m, voxels.resolution_m)


def signed_distances(blocked: NDArray[np.bool_], resolution_m: float) -> Distances:
    """Return the exact distance of each cell's centre to the surface between free and blocked cells.

    Args:
        blocked: (Z, Y, X).
        resolution_m: Edge of a cell.

    Returns:
        (Z, Y, X) float32 metres: positive in free cells, to the nearest square or cube that is blocked;
        negative in blocked ones; +inf where nothing is blocked, −inf where everything is.
    """
    distances = _half_cells(squares_to_boxes(blocked))
    distances[blocked] = -_half_cells(squares_to_boxes(~blocked))[blocked]
    distances *= np.float32(resolution_m / 2.0)
    return distances


def _half_cells(squares: NDArray[np.int32]) -> Distances:
    distances = np.sqrt(squares, dtype=np.float32)
    distances[squares == NONE] = np.inf
    return distances


@njit(cache=True, nogil=True)
def _interpolate(distances: Distances, corner: Array, resolution_m: float, points: Points) -> Distances:
    """Return the (N, 4) trilinear value and its gradient along x, y, z; NaN outside the box."""
    found = np.full((len(points), 4), np.nan, np.float32)
    depth, height, width = distances.shape
    for i in range(len(points)):
        x = (points[i, 0] - corner[0]) / resolution_m
        y = (points[i, 1] - corner[1]) / resolution_m
        z = (points[i, 2] - corner[2]) / resolution_m
        if 0.0 <= x <= width and 0.0 <= y <= height and 0.0 <= z <= depth:
            value, slope_z, slope_y, slope_x = interpolated(distances, z, y, x)
            found[i, 0] = value
            found[i, 1], found[i, 2], found[i, 3] = (
                slope_x / resolution_m,
                slope_y / resolution_m,
                slope_z / resolution_m,
            )
    return found


@njit(cache=True, nogil=True)
def interpolated(distances: Distances, z: float, y: float, x: float) -> tuple[float, float, float, float]:
    """Return the trilinear value at a position in cells, and its change per cell along z, y, x.

    Cell [0, 0, 0] spans 0 … 1. Beyond the outermost centres the value is constant.
    """
    depth, height, width = distances.shape
    z0, z1, up_z, slope_z = _between(z, depth)
    y0, y1, up_y, slope_y = _between(y, height)
    x0, x1, up_x, slope_x = _between(x, width)
    if np.isinf(distances[z0, y0, x0]):
        return distances[z0, y0, x0], np.nan, np.nan, np.nan  # then all are infinite, without a slope
    a, b = _mix(distances, z0, y0, x0, x1, up_x), _mix(distances, z0, y1, x0, x1, up_x)
    c, d = _mix(distances, z1, y0, x0, x1, up_x), _mix(distances, z1, y1, x0, x1, up_x)
    low, high = a + up_y * (b - a), c + up_y * (d - c)
    along_y = (b - a) + up_z * ((d - c) - (b - a))
    rows = (1.0 - up_z) * (1.0 - up_y), (1.0 - up_z) * up_y, up_z * (1.0 - up_y), up_z * up_y
    along_x = (
        rows[0] * (distances[z0, y0, x1] - distances[z0, y0, x0])
        + rows[1] * (distances[z0, y1, x1] - distances[z0, y1, x0])
        + rows[2] * (distances[z1, y0, x1] - distances[z1, y0, x0])
        + rows[3] * (distances[z1, y1, x1] - distances[z1, y1, x0])
    )
    return low + up_z * (high - low), (high - low) * slope_z, along_y * slope_y, along_x * slope_x


@njit(cache=True, nogil=True)
def _between(position: float, count: int) -> tuple[int, int, float, float]:
    """Return the cells with centres around a position, its fraction between them, and 1, or 0 beyond them."""
    clamped = min(max(position - 0.5, 0.0), count - 1.0)
    low = int(clamped)
    return low, min(low + 1, count - 1), clamped - low, 1.0 if clamped == position - 0.5 else 0.0


@njit(cache=True, nogil=True)
def _mix(distances: Distances, z: int, y: int, x0: int, x1: int, up: float) -> float:
    low, high = float(distances[z, y, x0]), float(distances[z, y, x1])
    return low + up * (high - low)
