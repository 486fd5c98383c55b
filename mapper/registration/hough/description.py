"""Description of a scan for Hough registration: its centres, its ground, its obstacles and its rays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Points32, Scan
from mapper.core.geometry import Array, Points, apply
from mapper.registration.free_space import ScanDescription, range_image
from mapper.registration.hough.config import HoughConfig
from mapper.registration.hough.ground_removal import Ground, surroundings
from mapper.registration.hough.object_detection import centres_of
from mapper.registration.hough.planar_kernels import draw_volume

DIRECTION_RAD = 0.0175
"""Resolution of the range image: one degree."""


@dataclass(frozen=True, slots=True, eq=False)
class HoughDescription:
    """Description of one scan, on either side of a registration.

    Attributes:
        centres_level: (N, 2) metres, level frame: the centres that vote.
        ground: The ground.
        ground_level: (G, 3) float32 metres, level frame: some points of it, evenly chosen.
        heights_m: (M,) float32 heights above the ground of the obstacles in ``free_space``.
        volume: (layers, E, E) uint8: all obstacles by height above the ground, as ``draw_volume`` returns
            them.
        free_space: Level frame, some of the obstacles, evenly chosen, and the rays.
    """

    centres_level: Array
    ground: Ground
    ground_level: Points32
    heights_m: NDArray[np.float32]
    volume: NDArray[np.uint8]
    free_space: ScanDescription

    def above_ground(self, points_body: Points, min_height_m: float) -> Points:
        """Return those of (N, 3) points in the body frame that lie higher than this above the ground."""
        x, y, z = apply(self.free_space.T_level_body, points_body).T
        _, heights_m = self.ground.at(x, y)
        above: Points = points_body[z - heights_m > min_height_m]
        return above


def describe(scan: Scan, config: HoughConfig) -> HoughDescription:
    """Return the description of a scan."""
    around = surroundings(scan.points_body, config.constellation)
    ground, overlap = config.constellation.ground, config.overlap
    return HoughDescription(
        centres_level=centres_of(around.obstacles, config.constellation.centres),
        ground=around.ground,
        ground_level=_evenly_chosen(around.ground.points_level.astype(np.float32), overlap.obstacles),
        heights_m=_evenly_chosen(around.heights_m, overlap.obstacles),
        volume=draw_volume(
            around.obstacles,
            around.heights_m,
            overlap.voxel_m,
            2 * int(np.ceil(ground.radius_m / overlap.voxel_m)),
            ground.min_obstacle_m,
            int((ground.max_obstacle_m - ground.min_obstacle_m) / overlap.voxel_m) + 1,
        ),
        free_space=ScanDescription(
            around.levelling.T_level_body,
            _evenly_chosen(around.obstacles, overlap.obstacles),
            range_image(_evenly_chosen(scan.points_body, overlap.rays), scan.origin_body, DIRECTION_RAD),
            DIRECTION_RAD,
            scan.origin_body,
        ),
    )


def _evenly_chosen(values: NDArray[np.float32], limit: int) -> NDArray[np.float32]:
    """Return at most ``limit`` rows."""
    return np.ascontiguousarray(values[:: max(1, -(-len(values) // limit))])
