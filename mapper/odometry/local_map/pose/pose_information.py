"""Information of poses in the local map, from landmarks and depth images, in the body's tangent."""

import math

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform, adjoint, inverse
from mapper.odometry.local_map.landmarks.landmark_map import MIN_SHARED_LANDMARKS, Ids, LandmarkMap
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose
from mapper.odometry.local_map.pose.triangulation import weights_with_landmarks
from mapper.registration.reprojection import normal_matrix
from mapper.registration.variance_factor import (
    ResidualStatistics,
    disparity_variance_ratio,
    residual_statistics,
)

_WEAK_PRIOR = np.diag([1.0] * 3 + [0.01] * 3)
"""1 rad and 10 m: keeps the information positive definite where few landmarks leave it singular."""


def frame_information(landmark_map: LandmarkMap, tracked_pose: TrackedPose) -> Array:
    """Return the (6, 6) information of a frame's pose, (rotation, translation), with landmarks as fixed."""
    observation, ids = tracked_pose.observation, tracked_pose.landmark_of_feature
    T_camera_world, features = tracked_pose.T_camera_world, np.flatnonzero(ids >= 0)
    weights = weights_with_landmarks(
        landmark_map, T_camera_world, observation, features, ids[features], observation.weights
    )
    H_camera = normal_matrix(
        T_camera_world,
        landmark_map.landmarks["position"][ids[features]],
        observation.measured[features],
        weights[features],
        observation.intrinsics,
    )
    information = _of_body(H_camera, observation.T_body_camera) + _WEAK_PRIOR
    if tracked_pose.depth is not None:
        information += _of_body(tracked_pose.depth.information, observation.T_body_camera)
    return information


def relative_information(landmark_map: LandmarkMap, target: int, source: int) -> Array:
    """Return the (6, 6) information of a keyframe's pose in another one, from landmarks and depth images.

    The shared landmarks are taken as fixed in the target. They were measured no better than the source's
    features, so their information is halved. Tangent of the source's body, (rotation, translation).
    """
    keyframe = landmark_map.keyframes[source]
    shared, _, features = np.intersect1d(
        landmark_map.landmarks_of(target), landmark_map.landmark_of_feature(source), return_indices=True
    )
    observation = landmark_map.observation(source)
    weights = weights_with_landmarks(
        landmark_map, keyframe.T_camera_world, observation, features, shared, observation.weights
    )
    H_camera = 0.5 * normal_matrix(
        keyframe.T_camera_world,
        landmark_map.landmarks["position"][shared],
        observation.measured[features],
        weights[features],
        observation.intrinsics,
    )
    information = _of_body(H_camera, keyframe.T_body_camera) + _WEAK_PRIOR
    if keyframe.depth_link is not None and keyframe.depth_link.reference == target:
        information += _of_body(keyframe.depth_link.information, keyframe.T_body_camera)
    return information


def keyframe_residuals(landmark_map: LandmarkMap, index: int) -> ResidualStatistics | None:
    """Return the statistics of a keyframe's residuals; None where few landmarks have another observer."""
    features, ids = _seen_by_others(landmark_map, index)
    if len(features) < MIN_SHARED_LANDMARKS:
        return None
    observation = landmark_map.observation(index)
    return residual_statistics(
        landmark_map.keyframes[index].T_camera_world,
        landmark_map.landmarks["position"][ids],
        observation.measured[features],
        observation.weights[features],
        observation.intrinsics,
        # A landmark is the mean of what its observers saw.
        redundancy=1.0 - 1.0 / landmark_map.landmarks["observers"][ids],
    )


def disparity_ratio(landmark_map: LandmarkMap, index: int) -> float | None:
    """Return the variance of a keyframe's virtual disparities relative to that of its pixels.

    None where few landmarks with depth have another observer.
    """
    features, ids = _seen_by_others(landmark_map, index)
    observation = landmark_map.observation(index)
    is_measured = landmark_map.landmarks["ray_sigma_m"][ids] == 0.0
    is_measured &= ~np.isnan(observation.measured[features, 2]) & ~observation.on_outline[features]
    features, ids = features[is_measured], ids[is_measured]
    if len(features) < MIN_SHARED_LANDMARKS:
        return None
    return disparity_variance_ratio(
        landmark_map.keyframes[index].T_camera_world,
        landmark_map.landmarks["position"][ids],
        observation.measured[features],
        observation.weights[features, 0] ** -0.5,
        observation.intrinsics,
    )


def _seen_by_others(landmark_map: LandmarkMap, index: int) -> tuple[NDArray[np.intp], Ids]:
    """Return a keyframe's features of landmarks that others observe as well, and these."""
    ids = landmark_map.landmark_of_feature(index)
    features = np.flatnonzero((ids >= 0) & (landmark_map.landmarks["observers"][ids] > 1))
    return features, ids[features]


def with_systematic(information: Array, tracked_pose: TrackedPose) -> Array:
    """Return the (6, 6) information of a frame's pose, less what distortion of its depth may have changed."""
    if tracked_pose.depth is None:
        return information
    Ad_body_camera = adjoint(tracked_pose.observation.T_body_camera)
    systematic = Ad_body_camera @ tracked_pose.depth.systematic @ Ad_body_camera.T
    return covariance_of(covariance_of(information) + systematic)


def covariance_of(information: Array) -> Array:
    """Return the covariance of an (N, N) information matrix."""
    return np.asarray(np.linalg.inv(information), np.float64)


def largest_sigma(covariance: Array) -> float:
    """Return the standard deviation along the axis of an (N, N) covariance where it is largest."""
    return math.sqrt(float(np.linalg.eigvalsh(covariance)[-1]))


def _of_body(H_camera: Array, T_body_camera: Transform) -> Array:
    """Return the information of a camera's tangent in its body's."""
    to_camera = adjoint(inverse(T_body_camera))
    return to_camera.T @ H_camera @ to_camera
