"""Where a frame was found, and the seam between the ways of finding it."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform, apply
from mapper.odometry.local_map.landmarks import Ids
from mapper.odometry.local_map.observation import Observation
from mapper.registration.reprojection import refine_pose

MAX_HAMMING = 64
"""Descriptors that differ in more of their 256 bits never match."""

_LM_ROUNDS, _LM_ITERATIONS = 3, 8


@dataclass(frozen=True, slots=True, eq=False)
class TrackedPose:
    """Where a frame was found.

    Attributes:
        observation: The frame.
        T_camera_world: (4, 4).
        landmark_of_feature: (N,) int32 landmark that each feature shows, −1 for none; inliers only.
        reference: Keyframe that sees most of these landmarks.
        matches: Pairs that were proposed.
        residual_px: Root mean square image residual of the inliers.
        method: What found it, e.g. "map", "fallback" or "relocalised".
    """

    observation: Observation
    T_camera_world: Transform
    landmark_of_feature: Ids
    reference: int
    matches: int
    residual_px: float
    method: str

    @property
    def inliers(self) -> int:
        """How many features agree with the pose."""
        return int((self.landmark_of_feature >= 0).sum())


class PoseTracker(Protocol):
    """How a frame is placed while tracking has not lost its thread."""

    def place(
        self, observation: Observation, last: TrackedPose, before_last: TrackedPose | None, /
    ) -> TrackedPose | None:
        """Return where the frame was found, given the two placed before it; None means "not found"."""
        ...


def unmatched(observation: Observation) -> Ids:
    """Return (N,) landmark −1, "none", of every feature."""
    return np.full(len(observation), -1, np.int32)


def project(T_camera_world: Transform, points_world: Points, intrinsics: Array) -> Array:
    """Return the pixels of world points; those behind the camera land far outside the image."""
    points_camera = apply(T_camera_world, points_world)
    z = np.where(points_camera[:, 2] > 0.05, points_camera[:, 2], np.nan)
    pixels = points_camera[:, :2] / z[:, None] * intrinsics[:2] + intrinsics[2:4]
    return np.nan_to_num(pixels, nan=-1e6)


def rms_px(
    T_camera_world: Transform, points_world: Points, observation: Observation, features: NDArray[np.integer]
) -> float:
    """Return the root mean square distance, in pixels, of points from the features that show them."""
    miss_px = project(T_camera_world, points_world, observation.intrinsics) - observation.pixels[features]
    return math.sqrt(float((miss_px**2).sum(axis=1).mean()))


def refined(
    T_camera_world: Transform,
    points_world: Points,
    observation: Observation,
    features: NDArray[np.integer],
) -> tuple[Transform, NDArray[np.bool_]]:
    """Return the refined T_camera_world and which pairs agree with it."""
    T_refined, inlier, _ = refine_pose(
        T_camera_world,
        points_world,
        observation.measured[features],
        observation.weights[features],
        observation.intrinsics,
        _LM_ROUNDS,
        _LM_ITERATIONS,
    )
    return T_refined, inlier
