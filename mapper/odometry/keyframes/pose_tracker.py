"""Interface of the pose trackers: the pose of a frame in the local map, and the methods that find it."""

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mapper.core.doubts import Doubt
from mapper.core.geometry import Array, Points, Transform, apply, exp, inverse, log
from mapper.odometry.camera.image_observation import ImageObservation
from mapper.odometry.keyframes.depth_alignment import DepthAlignment
from mapper.odometry.keyframes.landmarks import Ids
from mapper.registration.reprojection import NEAREST_M, refine_pose

WEAK_INLIERS = 150
"""With fewer, a pose may be wrong, and is compared with others: repeated structure has led to a hundred."""
_MAX_PREDICTED_STEPS = 10.0
"""Over longer gaps, in frame intervals, constant velocity predicts worse than no motion."""
_LM_ROUNDS, _LM_ITERATIONS = 3, 8


@dataclass(frozen=True, slots=True, eq=False)
class TrackedPose:
    """Pose of a frame in the local map, with the landmarks that support it.

    Attributes:
        observation: The frame.
        T_camera_world: (4, 4).
        landmark_of_feature: (N,) int32 landmark of each feature, −1 for none; inliers only.
        reference: Keyframe that observes most of these landmarks.
        matches: Number of proposed pairs.
        visible: Number of the map's landmarks that should be in view.
        residual_px: Root mean square image residual of the inliers.
        method: Step that found the pose, e.g. "map", "fallback" or "relocalised".
        depth: Alignment of the depth image that took part in the pose; None if landmarks alone gave it.
        doubts: Why the pose may be wrong.
        moving: (M,) int32 features that stand where earlier depth images saw through, or that contradict the
            pose while something else moves in view.
    """

    observation: ImageObservation
    T_camera_world: Transform
    landmark_of_feature: Ids
    reference: int
    matches: int
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


class PoseTracker(Protocol):
    """Method that finds the pose of a frame while the frame before it was tracked."""

    def track(
        self, observation: ImageObservation, last: TrackedPose, T_predicted: Transform | None, /
    ) -> TrackedPose | None:
        """Return the pose of a frame, given that of the frame before it; None if it is not found.

        Args:
            observation: The frame.
            last: The frame before it.
            T_predicted: T_camera_world (4, 4) by the motion; None if nothing tells it.
        """
        ...


def unmatched(observation: ImageObservation) -> Ids:
    """Return (N,) landmark −1, which is none, for every feature."""
    return np.full(len(observation), -1, np.int32)


def predict_by_velocity(
    stamp_ns: int, last: TrackedPose, before_last: TrackedPose | None
) -> Transform | None:
    """Return T_camera_world under constant velocity, also across dropped frames; None if nothing tells it."""
    if before_last is None:
        return None
    t0, t1 = before_last.observation.stamp_ns, last.observation.stamp_ns
    steps = (stamp_ns - t1) / (t1 - t0)
    if steps > _MAX_PREDICTED_STEPS:
        return None
    rotation_rad, translation_m = log(last.T_camera_world @ inverse(before_last.T_camera_world))
    T_camera_world: Transform = exp(steps * rotation_rad, steps * translation_m) @ last.T_camera_world
    return T_camera_world


def predict_by_turn(last: TrackedPose, T_by_velocity: Transform | None, R_last_body: Array) -> Transform:
    """Return T_camera_world with a measured rotation of the body since, and the predicted position."""
    T_body_camera, T_world_body = last.observation.T_body_camera, last.body_pose.copy()
    if T_by_velocity is not None:
        T_world_body[:3, 3] = inverse(T_body_camera @ T_by_velocity)[:3, 3]
    T_world_body[:3, :3] = T_world_body[:3, :3] @ R_last_body
    return inverse(T_world_body @ T_body_camera)


def project(T_camera_world: Transform, points_world: Points, intrinsics: Array) -> Array:
    """Return the pixels of world points; those behind the camera are far outside the image."""
    points_camera = apply(T_camera_world, points_world)
    z = np.where(points_camera[:, 2] > NEAREST_M, points_camera[:, 2], np.nan)
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
