"""Description of a scan for Hough registration: its centres, its ground, its obstacles and its rays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Scan
from mapper.core.geometry import Array, Points, Transform, apply, stride_for
from mapper.registration.free_space import ScanDescription, range_image
from mapper.registration.hough.config import HoughConfig
from mapper.registration.hough.ground import Ground, surroundings
from mapper.registration.hough.object_detection import centres_of
from mapper.registration.hough.planar_kernels import draw_volume

DIRECTION_RAD = 0.0175
"""Resolution of the range image: one degree."""


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
    ground, overlap = config.constellation.ground, config.overlap
    ranges_m = range_image(_evenly_chosen(scan.points_body, overlap.rays), scan.origin_body, DIRECTION_RAD)
    obstacles, ground_points = (
        ScanDescription(
            around.levelling.T_level_body,
            _evenly_chosen(points_level, overlap.obstacles),
            ranges_m,
            DIRECTION_RAD,
            scan.origin_body,
        )
        for points_level in (around.obstacles, around.ground.points_level.astype(np.float32))
    )
    volume = draw_volume(
        around.obstacles,
        around.heights_m,
        overlap.voxel_m,
        2 * int(np.ceil(ground.radius_m / overlap.voxel_m)),
        ground.min_obstacle_m,
        int((ground.max_obstacle_m - ground.min_obstacle_m) / overlap.voxel_m) + 1,
    )
    return HoughDescription(
        around.levelling.T_level_body,
        centres_of(around.obstacles, config.constellation.centres),
        around.ground,
        _evenly_chosen(around.heights_m, overlap.obstacles),
        volume,
        obstacles,
        ground_points,
    )


def _evenly_chosen(values: NDArray[np.float32], limit: int) -> NDArray[np.float32]:
    """Return at most ``limit`` rows."""
    return np.ascontiguousarray(values[:: stride_for(len(values), limit)])
