"""Interface of the pose trackers: the pose of a frame in the local map, and the methods that find it."""

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mapper.core.doubts import Doubt
from mapper.core.geometry import Array, Points, Transform, apply, inverse
from mapper.odometry.base import Diagnostics
from mapper.odometry.local_map.depth.depth_alignment import DepthAlignment
from mapper.odometry.local_map.landmarks.landmark_map import Ids
from mapper.odometry.local_map.observation.image_observation import FEW_MOVING, ImageObservation
from mapper.odometry.local_map.pose.moving_features import among_moving
from mapper.registration.reprojection import refine_pose

MAX_HAMMING = 64
"""Descriptors that differ in more of their 256 bits do not match."""

_LM_ROUNDS, _LM_ITERATIONS = 3, 8


@dataclass(frozen=True, slots=True, eq=False)
class TrackedPose:
    """Pose of a frame in the local map, with the landmarks that support it.

    Attributes:
        observation: The frame.
        T_camera_world: (4, 4).
        landmark_of_feature: (N,) int32 landmark of each feature, −1 for none; inliers only.
        reference: Keyframe that observes most of these landmarks.
        matches: Number of matched pairs, inliers or not.
        agreement: Share of the first matches, before the local map is searched, that agree with the pose.
        visible: Number of the map's landmarks that should be in view.
        residual_px: Root mean square image residual of the inliers.
        method: Step that found the pose, e.g. "map", "fallback" or "relocalised".
        depth: Alignment of the depth image that took part in the pose; None if landmarks alone gave it.
        doubts: Why the pose may be wrong.
        moving: (M,) int32 features in the free space of earlier depth images, or that contradict the
            pose while something else moves in view.
    """

    observation: ImageObservation
    T_camera_world: Transform
    landmark_of_feature: Ids
    reference: int
    matches: int
    agreement: float
    visible: int
    residual_px: float
    method: str
    depth: DepthAlignment | None = None
    doubts: tuple[Doubt, ...] = ()
    moving: Ids = field(default_factory=lambda: np.empty(0, np.int32))

    @property
    def stamp_ns(self) -> int:
        """The frame's stamp."""
        return self.observation.stamp_ns

    @property
    def body_pose(self) -> Transform:
        """(4, 4) T_world_body."""
        return inverse(self.observation.T_body_camera @ self.T_camera_world)

    @property
    def inliers(self) -> int:
        """Number of features that agree with the pose."""
        return int((self.landmark_of_feature >= 0).sum())

    def diagnostics(self, inliers: int) -> Diagnostics:
        """Return the figures on its tracking, with the inliers that it had then."""
        image = Diagnostics(
            features=len(self.observation),
            matches=self.matches,
            inliers=inliers,
            residual=self.residual_px,
            residual_unit="px",
            method=self.method,
        )
        return image if self.depth is None else self.depth.diagnostics(image)

    @property
    def few_move(self) -> bool:
        """Whether next to no features move by themselves."""
        return len(self.moving) <= FEW_MOVING * len(self.observation)

    def moving_cells(self) -> NDArray[np.bool_] | None:
        """Return (C,) which cells of the depth image are among moving features; None if few move."""
        cells = self.observation.depth_cells
        if cells is None or self.few_move:
            return None
        is_moving, features = self.observation.mask_of(self.moving), self.observation.points_camera
        return among_moving(cells.points(), features, is_moving, self.landmark_of_feature >= 0)


class PoseTracker(Protocol):
    """Method that finds the pose of a frame while the frame before it was tracked."""

    def track(
        self, observation: ImageObservation, last: TrackedPose, T_predicted: Transform | None, /
    ) -> TrackedPose | None:
        """Return the pose of a frame, given that of the frame before it; None if it is not found.

        ``T_predicted`` is the predicted (4, 4) T_camera_world, None if nothing predicts it.
        """
        ...


def unmatched(observation: ImageObservation) -> Ids:
    """Return (N,) landmark −1, which is none, for every feature."""
    return np.full(len(observation), -1, np.int32)


def project(T_camera_world: Transform, points_world: Points, intrinsics: Array) -> Array:
    """Return the pixels of world points; those behind the camera are far outside the image."""
    points_camera = apply(T_camera_world, points_world)
    z = np.where(points_camera[:, 2] > 0.05, points_camera[:, 2], np.nan)
    pixels = points_camera[:, :2] / z[:, None] * intrinsics[:2] + intrinsics[2:4]
    return np.nan_to_num(pixels, nan=-1e6)


def rms_px(
    T_camera_world: Transform,
    points_world: Points,
    observation: ImageObservation,
    features: NDArray[np.integer],
) -> float:
    """Return the root mean square distance, in pixels, between projected points and their features."""
    residual_px = (
        project(T_camera_world, points_world, observation.intrinsics) - observation.measured[features, :2]
    )
    return math.sqrt(float((residual_px**2).sum(axis=1).mean()))


def refined(
    T_camera_world: Transform,
    points_world: Points,
    observation: ImageObservation,
    features: NDArray[np.integer],
    weights: Array | None = None,
) -> tuple[Transform, NDArray[np.bool_]]:
    """Return the refined T_camera_world and which pairs agree with it."""
    T_refined, inlier, _ = refine_pose(
        T_camera_world,
        points_world,
        observation.measured[features],
        (observation.weights if weights is None else weights)[features],
        observation.intrinsics,
        _LM_ROUNDS,
        _LM_ITERATIONS,
    )
    return T_refined, inlier
