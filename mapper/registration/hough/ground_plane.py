"""Ground plane under the sensor of a single scan, by random samples (Fischler & Bolles 1981)."""

from dataclasses import dataclass

import numpy as np

from mapper.core.frames import Points32
from mapper.core.geometry import Array, Points, Transform, transform, turn_to_z
from mapper.registration.hough.config import LevellingConfig
from mapper.registration.hough.ground_kernels import score_planes, thin

LEVEL_ABOVE_RAD = 0.09
"""A smaller tilt stays: on a sloping street the plane would tilt what gravity has levelled."""
BELOW_WEIGHT = 1.0
"""Cost of a point below the plane, in inliers: nothing lies below the ground."""
MIN_INLIER_RATIO = 0.03
"""With a smaller share of inliers there is no ground, and the scan is taken as level."""
_REFITS = 3


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
    tilt_rad: float
    inlier_ratio: float


_WITHOUT_GROUND = Levelling(np.eye(4), 0.0, 0.0)


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
    triples = np.random.default_rng(config.seed).integers(0, len(few), (config.samples, 3))
    plane, score = score_planes(
        few,
        triples,
        np.cos(config.max_tilt_rad),
        config.min_height_m,
        config.max_height_m,
        config.inlier_m,
        BELOW_WEIGHT,
    )
    if score < 0.0:
        return _WITHOUT_GROUND
    for _ in range(_REFITS):
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
