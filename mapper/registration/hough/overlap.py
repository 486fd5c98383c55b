"""Whether a motion fits what two scans saw: their obstacles, their ground and their lines of sight."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Points32, Scan
from mapper.core.geometry import Array, Points, Transform, apply, inverse, rotation_exp, transform
from mapper.registration.hough.config import HoughConfig, OverlapConfig
from mapper.registration.hough.ground_removal import Ground, surroundings
from mapper.registration.hough.object_detection import centres_of
from mapper.registration.hough.overlap_kernels import NEAR, climb, draw_volume, look, range_picture

_FITS = 3
_FIT_WIDTH_M = 0.5
_MIN_FIT_CELLS = 30
_FIT_RIDGE = 1.0
"""Weight, in cells, of the wish not to tilt."""


@dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """What one scan has to say about a motion.

    Attributes:
        T_level_body: (4, 4) the frame that most of it is told in.
        centres_level: (N, 2) its constellation, metres.
        ground: Its ground.
        ground_level: (G, 3) float32 some points of it, metres.
        obstacles_level: (M, 3) float32 some of its obstacles, metres.
        heights_m: (M,) float32 their heights above the ground.
        volume: (layers, E, E) uint8 all its obstacles, drawn thick, by height above the ground.
        picture: Ranges by direction, body frame.
        origin_body: (3,) where the lines of sight begin.
    """

    T_level_body: Transform
    centres_level: Array
    ground: Ground
    ground_level: Points32
    obstacles_level: Points32
    heights_m: NDArray[np.float32]
    volume: NDArray[np.uint8]
    picture: NDArray[np.float32]
    origin_body: Array

    def above_ground(self, points_body: Points, least_m: float) -> Points:
        """Return those of (N, 3) points in the body frame that are higher than so much above the ground."""
        x, y, z = apply(self.T_level_body, points_body).T
        _, heights_m = self.ground.at(x, y)
        above: Points = points_body[z - heights_m > least_m]
        return above


def witness(scan: Scan, config: HoughConfig) -> Witness:
    """Return what a scan has to say."""
    around = surroundings(scan.points_body, config.constellation)
    centres_level = centres_of(around.obstacles, config.constellation.centres)
    ground, overlap = config.constellation.ground, config.overlap
    return Witness(
        T_level_body=around.levelling.T_level_body,
        centres_level=centres_level,
        ground=around.ground,
        ground_level=_some(around.ground.points_level.astype(np.float32), overlap.obstacles),
        obstacles_level=_some(around.obstacles, overlap.obstacles),
        heights_m=_some(around.heights_m, overlap.obstacles),
        volume=draw_volume(
            around.obstacles,
            around.heights_m,
            overlap.voxel_m,
            2 * int(np.ceil(ground.radius_m / overlap.voxel_m)),
            ground.min_obstacle_m,
            int((ground.max_obstacle_m - ground.min_obstacle_m) / overlap.voxel_m) + 1,
        ),
        picture=range_picture(
            _some(scan.points_body, overlap.rays),
            scan.origin_body,
            overlap.direction_rad,
        ),
        origin_body=scan.origin_body,
    )


def _some(values: NDArray[np.float32], most: int) -> NDArray[np.float32]:
    """Return at most so many rows, evenly chosen."""
    return np.ascontiguousarray(values[:: max(1, -(-len(values) // most))])


@dataclass(frozen=True, slots=True)
class PlanarFit:
    """A planar motion between level frames, and how much of the source it lays on the target's obstacles.

    Attributes:
        dx_m: Offset along the target's level x.
        dy_m: Offset along its y.
        alpha_rad: Turn about up.
        overlap: 0 … 1.
    """

    dx_m: float
    dy_m: float
    alpha_rad: float
    overlap: float

    def is_near(self, other: "PlanarFit", config: OverlapConfig) -> bool:
        """Tell whether two are the same motion."""
        turn = np.angle(np.exp(1j * (self.alpha_rad - other.alpha_rad)))
        return bool(
            np.hypot(self.dx_m - other.dx_m, self.dy_m - other.dy_m) <= config.distinct_m
            and abs(turn) <= config.distinct_rad
        )


def refine_planar(
    target: Witness, source: Witness, motion: tuple[float, float, float], config: HoughConfig
) -> PlanarFit:
    """Return the planar motion near (dx, dy, α) under which the obstacles overlap most."""
    overlap = config.overlap
    (dx_m, dy_m, alpha_rad), total = climb(
        target.volume,
        source.obstacles_level,
        source.heights_m,
        np.array(motion),
        overlap.voxel_m,
        config.constellation.ground.min_obstacle_m,
        overlap.step_m,
        overlap.step_rad,
        overlap.halvings,
    )
    share = total / (NEAR * max(len(source.heights_m), 1))
    return PlanarFit(float(dx_m), float(dy_m), float(alpha_rad), float(share))


def settled(target: Ground, source: Ground, fit: PlanarFit) -> Transform:
    """Return T_target_source between the level frames: the planar motion, with ground laid on ground.

    What is left between the grounds, a step and a slope, is fitted by least squares under Tukey's biweight
    (Beaton & Tukey 1974). Where too little ground was seen by both, the levels are trusted.
    """
    cosine, sine = np.cos(fit.alpha_rad), np.sin(fit.alpha_rad)
    R = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    T = transform(R, np.array([fit.dx_m, fit.dy_m, 0.0]))
    x, y, z = apply(T, source.points_level).T
    seen, heights = target.at(x, y)
    if seen.sum() < _MIN_FIT_CELLS:
        return T
    rows = np.column_stack([np.ones(len(x)), x, y])[seen]
    gaps_m = heights[seen] - z[seen]
    plane = np.array([np.median(gaps_m), 0.0, 0.0])
    for _ in range(_FITS):
        weights = np.clip(1.0 - ((gaps_m - rows @ plane) / _FIT_WIDTH_M) ** 2, 0.0, None) ** 2
        weighted = rows * weights[:, np.newaxis]
        plane = np.linalg.solve(weighted.T @ rows + _FIT_RIDGE * np.eye(3), weighted.T @ gaps_m)
    step, slope_x, slope_y = plane
    tilt = transform(rotation_exp(np.array([slope_y, -slope_x, 0.0])), np.array([0.0, 0.0, step]))
    return tilt @ T


@dataclass(frozen=True, slots=True)
class Overlap:
    """How two scans agree under a motion, by shares of what is looked at of each.

    Attributes:
        source_agree: Of the source's obstacles, those on surfaces that the target saw.
        source_through: Of the source's obstacles, those that the target looked through.
        target_agree: Of the target's obstacles, those on surfaces that the source saw.
        target_through: Of the target's obstacles, those that the source looked through.
        ground: Of the ground, that on surfaces that the other saw; the larger share of the two.
    """

    source_agree: float
    source_through: float
    target_agree: float
    target_through: float
    ground: float

    @property
    def agree(self) -> float:
        """The smaller share of obstacles that agree."""
        return min(self.source_agree, self.target_agree)

    @property
    def through(self) -> float:
        """The mean share of obstacles that contradict."""
        return 0.5 * (self.source_through + self.target_through)

    def score(self, contradiction_weight: float) -> float:
        """Return the mean share that agrees, less the weighted mean share that contradicts."""
        return 0.5 * (self.source_agree + self.target_agree) - contradiction_weight * self.through


def overlap_under(
    target: Witness, source: Witness, T_target_source: Transform, config: OverlapConfig
) -> Overlap:
    """Return how two scans agree under a motion between their body frames."""
    T_target_level = T_target_source @ inverse(source.T_level_body)
    T_source_level = inverse(T_target_source) @ inverse(target.T_level_body)
    source_agree, source_through = _seen(target, source.obstacles_level, T_target_level, config)
    target_agree, target_through = _seen(source, target.obstacles_level, T_source_level, config)
    return Overlap(
        source_agree,
        source_through,
        target_agree,
        target_through,
        ground=max(
            _seen(target, source.ground_level, T_target_level, config)[0],
            _seen(source, target.ground_level, T_source_level, config)[0],
        ),
    )


def _seen(
    by: Witness, points_level: Points32, T_by_level: Transform, config: OverlapConfig
) -> tuple[float, float]:
    """Return the shares of points in a level frame that a scan agrees with and contradicts."""
    agree, through = look(
        by.picture,
        by.origin_body,
        points_level,
        T_by_level,
        config.direction_rad,
        config.margin_m,
        config.margin_ratio,
        config.min_returns,
    )
    count = max(len(points_level), 1)
    return agree / count, through / count
