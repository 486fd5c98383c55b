"""Ground of a scan and the obstacles on it.

The level frame is that of the plane under the sensor, by random samples (Fischler & Bolles 1981); ground and
obstacles are found on a grid in it (Nagy, Gálai & Benedek 2016, §3.1).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Array, Points, Transform, transform, turn_to_z
from mapper.registration.hough.config import ConstellationConfig, GroundConfig, LevellingConfig
from mapper.registration.hough.ground_kernels import column_heights, score_planes, thin, thin_obstacles

LEVEL_ABOVE_RAD = 0.09
"""A smaller tilt stays: on a sloping street the plane would tilt what gravity has levelled."""
MIN_INLIER_RATIO = 0.03
"""With a smaller share of inliers there is no ground, and the scan is taken as level."""
FITS = 3
_SAMPLES = 400  # planes that are tried
MIN_POINTS = 3
"""Columns with fewer points are noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Levelling:
    """Level frame of a scan.

    Attributes:
        T_level_body: (4, 4) turns z up and puts the ground below the sensor at z = 0; identity without
            ground.
        tilt_rad: Angle between body z and the ground's normal; 0 without ground.
        inlier_ratio: Share of the thinned points on the ground plane; 0 without ground.
    """

    T_level_body: Transform
    tilt_rad: float = 0.0
    inlier_ratio: float = 0.0


_WITHOUT_GROUND = Levelling(np.eye(4))


def level(points_body: Points32, config: LevellingConfig) -> Levelling:
    """Return the level frame of a scan; a scan without ground is taken as it is.

    The best of many planes through three random points is refitted to its inliers. The scan is turned only
    when its tilt is larger than ``LEVEL_ABOVE_RAD``.

    Args:
        points_body: (N, 3) metres, z less than ``max_tilt_rad`` from up.
        config: Settings.
    """
    few = points_body[thin(points_body, config.cell_m, config.reach_m)].astype(np.float64)
    if len(few) < 3:
        return _WITHOUT_GROUND
    triples = np.random.default_rng(config.seed).integers(0, len(few), (_SAMPLES, 3))
    plane, score = score_planes(
        few,
        triples,
        np.cos(config.max_tilt_rad),
        config.min_height_m,
        config.max_height_m,
        config.inlier_m,
    )
    if score < 0.0:
        return _WITHOUT_GROUND
    for _ in range(FITS):
        plane = _refitted(few, plane, config.inlier_m)
    up, height_m = plane[:3], float(plane[3])
    ratio = float((np.abs(few @ up + height_m) <= config.inlier_m).mean())
    if ratio < MIN_INLIER_RATIO:
        return _WITHOUT_GROUND
    tilt_rad = float(np.arccos(np.clip(up[2], -1.0, 1.0)))
    R = turn_to_z(up) if tilt_rad > LEVEL_ABOVE_RAD else np.eye(3)
    return Levelling(transform(R, np.array([0.0, 0.0, height_m])), tilt_rad, ratio)


def _refitted(points: Points, plane: Array, inlier_m: float) -> Array:
    """Return the least-squares plane of the inliers: the axis of their least spread."""
    inliers = points[np.abs(points @ plane[:3] + plane[3]) <= inlier_m]
    centre = inliers.mean(axis=0)
    offsets = inliers - centre
    up = np.linalg.eigh(offsets.T @ offsets)[1][:, 0]
    up *= np.copysign(1.0, up[2])
    return np.append(up, -up @ centre)


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Ground around a scan, in its level frame.

    Attributes:
        heights_level: (E, E) float32 z of the ground in each column of a grid centred on the origin, rows
            along y; 0 where no ground is near.
        seen: (E, E) bool: points of the ground fell into the column.
        cell_m: Edge of a column.
    """

    heights_level: NDArray[np.float32]
    seen: NDArray[np.bool_]
    cell_m: float

    @property
    def points_level(self) -> Points:
        """(G, 3) metres: the ground at the middle of each column with points of it."""
        rows, columns = np.nonzero(self.seen)
        half = 0.5 * len(self.seen) - 0.5
        x, y = (columns - half) * self.cell_m, (rows - half) * self.cell_m
        return np.column_stack([x, y, self.heights_level[rows, columns]])

    def at(self, x: Array, y: Array) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """Return for (N,) positions whether their column has points of the ground, and its height, metres."""
        edge = len(self.seen)
        columns = np.floor(x / self.cell_m + 0.5 * edge).astype(np.intp)
        rows = np.floor(y / self.cell_m + 0.5 * edge).astype(np.intp)
        inside = (columns >= 0) & (columns < edge) & (rows >= 0) & (rows < edge)
        rows, columns = np.where(inside, rows, 0), np.where(inside, columns, 0)
        return inside & self.seen[rows, columns], self.heights_level[rows, columns]


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """A scan divided into ground and obstacles.

    Attributes:
        levelling: Level frame of the scan.
        ground: The ground.
        obstacles: (M, 3) float32 metres, level frame, one point per voxel.
        heights_m: (M,) float32 heights of the obstacles above the ground.
    """

    levelling: Levelling
    ground: Ground
    obstacles: Points32
    heights_m: NDArray[np.float32]


def surroundings(points_body: Points32, config: ConstellationConfig) -> Surroundings:
    """Return the ground and the obstacles of a scan.

    Args:
        points_body: (N, 3) metres, body frame, z less than ``levelling.max_tilt_rad`` from up.
        config: Settings.
    """
    levelling = level(points_body, config.levelling)
    T_level_body = levelling.T_level_body
    ground = find_ground(points_body, T_level_body, config.ground)
    obstacles, heights_m = find_obstacles(points_body, T_level_body, ground, config.ground)
    return Surroundings(levelling, ground, obstacles, heights_m)


def find_ground(points_body: Points32, T_level_body: Transform, config: GroundConfig) -> Ground:
    """Return the ground of a scan.

    A column is ground when it has enough points, is thin, and its mean is not much above the lowest thin
    column nearby. Between ground columns, the ground is at the mean of those within the window.
    """
    edge = 2 * int(np.ceil(config.radius_m / config.cell_m))
    count, low, high, mean = column_heights(points_body, T_level_body, config.cell_m, edge)
    thin = (count >= MIN_POINTS) & (high - low < config.max_thickness_m)
    size = 2 * int(0.5 * config.window_m / config.cell_m) + 1
    lowest = cv2.erode(np.where(thin, mean, np.float32(np.inf)), np.ones((size, size), np.uint8))
    seen = thin & (mean - lowest <= config.max_rise_m)
    total = cv2.boxFilter(np.where(seen, mean, np.float32(0.0)), -1, (size, size), normalize=False)
    weight = cv2.boxFilter(seen.astype(np.float32), -1, (size, size), normalize=False)
    smooth = np.where(weight > 0.5, total / np.maximum(weight, 1.0), np.float32(0.0))
    return Ground(np.where(seen, mean, smooth), seen, config.cell_m)


def find_obstacles(
    points_body: Points32, T_level_body: Transform, ground: Ground, config: GroundConfig
) -> tuple[Points32, NDArray[np.float32]]:
    """Return the points that are neither ground nor too high, one per voxel.

    Args:
        points_body: (N, 3) float32 metres, body frame.
        T_level_body: (4, 4) from the body frame to the level frame.
        ground: Ground of the same points, from ``find_ground``.
        config: Heights, radius and voxels.

    Returns:
        (M, 3) float32 in the level frame, and (M,) their heights above the ground, metres.
    """
    voxels_across = 2 * int(np.ceil(config.radius_m / config.voxel_m))
    obstacles = thin_obstacles(
        points_body,
        T_level_body,
        ground.heights_level,
        ground.cell_m,
        config.min_obstacle_m,
        config.max_obstacle_m,
        config.voxel_m,
        voxels_across,
    )
    return obstacles[:, :3], obstacles[:, 3]
