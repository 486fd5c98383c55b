"""Description of a scan for Hough registration: its centres, its ground, its obstacles and its rays.

Centres are those of the objects on the ground, seen from above (Nagy, Gálai & Benedek 2016, §3.2).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Points32, Scan
from mapper.core.geometry import Array, Points, Transform, apply, stride_for
from mapper.registration.free_space import DIRECTION_RAD, ScanDescription, range_image
from mapper.registration.hough.config import CellsConfig, HoughConfig, ObjectsConfig
from mapper.registration.hough.ground import Ground, surroundings
from mapper.registration.hough.voting_kernels import draw_volume


def centres_of(obstacles: Points32, config: CellsConfig | ObjectsConfig) -> Array:
    """Return the (N, 2) centres, metres, of the obstacles' objects or occupied cells.

    Args:
        obstacles: (M, 3) one point per voxel, as ``find_obstacles`` gives them.
        config: Cells or objects.
    """
    if len(obstacles) == 0:
        return np.empty((0, 2))
    flat = obstacles[:, :2].astype(np.float64)
    if isinstance(config, ObjectsConfig):
        component_of = _objects(flat, config)
    else:
        _, component_of = np.unique(_cell_numbers(flat, config.cell_m), return_inverse=True)
    sizes = np.bincount(component_of)
    sums = np.column_stack([np.bincount(component_of, weights=flat[:, axis]) for axis in range(2)])
    large = sizes >= _min_voxels(flat, config)
    return sums[large] / sizes[large, np.newaxis]


def _min_voxels(flat: Array, config: CellsConfig | ObjectsConfig) -> float:
    """Return the least number of voxels of an object or an occupied cell, in a cloud of this density."""
    cell_m = config.coarse_m if isinstance(config, ObjectsConfig) else config.cell_m
    _, counts = np.unique(_cell_numbers(flat, cell_m), return_counts=True)
    return max(1.0, _MIN_VOXELS_RATIO * float(np.median(counts)))


def _objects(flat: Array, config: ObjectsConfig) -> NDArray[np.intp]:
    """Return each voxel's object: its component by fine cells, or its group where no component is large."""
    group_of, component_of = _connected(flat, config.coarse_m), _connected(flat, config.fine_m)
    large = np.bincount(component_of) >= _min_voxels(flat, config)
    divided = np.zeros(group_of.max() + 1, np.bool_)
    divided[group_of[large[component_of]]] = True
    return np.where(divided[group_of], component_of, len(large) + group_of)


def _connected(flat: Array, cell_m: float) -> NDArray[np.intp]:
    """Return each point's component of cells that touch at a side or a corner."""
    cells = _cells(flat, cell_m)
    cells -= cells.min(axis=0)
    image = np.zeros(cells.max(axis=0) + 1, np.uint8)
    image[cells[:, 0], cells[:, 1]] = 1
    labels: NDArray[np.int32] = cv2.connectedComponents(image, connectivity=8)[1]
    return labels[cells[:, 0], cells[:, 1]].astype(np.intp) - 1


def _cell_numbers(flat: Array, cell_m: float) -> NDArray[np.int64]:
    """Return the number of each point's cell."""
    cells = _cells(flat, cell_m)
    cells -= cells.min(axis=0)
    numbers: NDArray[np.int64] = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    return numbers


def _cells(flat: Array, cell_m: float) -> NDArray[np.int64]:
    return np.floor(flat / cell_m).astype(np.int64)


_MIN_VOXELS_RATIO = 0.5
"""An object, or an occupied cell, has at least this many times the voxels of the cloud's median cell."""
_RAYS, _COMPARED = 40_000, 1000
"""Points of a scan, evenly chosen, whose rays make the range image; obstacles and ground columns that are
compared."""


@dataclass(frozen=True, slots=True, eq=False)
class HoughDescription:
    """Description of one scan, on either side of a registration.

    Attributes:
        T_level_body: (4, 4) from the body frame to the level frame.
        centres_level: (N, 2) metres, level frame: the centres that vote.
        ground: The ground.
        heights_m: (M,) float32 heights above the ground of the checked obstacles.
        volume: (layers, E, E) uint8: all obstacles by height above the ground, as ``draw_volume`` returns
            them.
        checked_obstacles: Some of the obstacles, evenly chosen, and the rays.
        checked_ground: Some of the ground, evenly chosen, and the rays.
    """

    T_level_body: Transform
    centres_level: Array
    ground: Ground
    heights_m: NDArray[np.float32]
    volume: NDArray[np.uint8]
    checked_obstacles: ScanDescription
    checked_ground: ScanDescription

    def above_ground(self, points_body: Points, min_height_m: float) -> Points:
        """Return those of (N, 3) points in the body frame that lie higher than this above the ground."""
        x, y, z = apply(self.T_level_body, points_body).T
        _, heights_m = self.ground.at(x, y)
        above: Points = points_body[z - heights_m > min_height_m]
        return above


def describe(scan: Scan, config: HoughConfig) -> HoughDescription:
    """Return the description of a scan."""
    around = surroundings(scan.points_body, config.constellation)
    ground = config.constellation.ground
    ranges_m = range_image(_evenly_chosen(scan.points_body, _RAYS), scan.origin_body, DIRECTION_RAD)
    obstacles, ground_points = (
        ScanDescription(
            around.levelling.T_level_body,
            _evenly_chosen(points_level, _COMPARED),
            ranges_m,
            DIRECTION_RAD,
            scan.origin_body,
        )
        for points_level in (around.obstacles, around.ground.points_level.astype(np.float32))
    )
    volume = draw_volume(
        around.obstacles,
        around.heights_m,
        ground.voxel_m,
        2 * int(np.ceil(ground.radius_m / ground.voxel_m)),
        ground.min_obstacle_m,
        int((ground.max_obstacle_m - ground.min_obstacle_m) / ground.voxel_m) + 1,
    )
    return HoughDescription(
        around.levelling.T_level_body,
        centres_of(around.obstacles, config.constellation.centres),
        around.ground,
        _evenly_chosen(around.heights_m, _COMPARED),
        volume,
        obstacles,
        ground_points,
    )


def _evenly_chosen(values: NDArray[np.float32], limit: int) -> NDArray[np.float32]:
    """Return at most ``limit`` rows."""
    return np.ascontiguousarray(values[:: stride_for(len(values), limit)])
