"""Which of several motions in an image is the camera's: people who walk by take their features along."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.doubts import Doubt
from mapper.core.geometry import Array, Points, Transform
from mapper.odometry.camera.image_observation import ImageObservation
from mapper.odometry.keyframes.pose_tracker import refined
from mapper.registration.reprojection import classify

_ENOUGH_ESTABLISHED = 30
"""Landmarks that decide which motion is the camera's."""
_LEAST_OBSERVERS, _MOST_OBSERVERS = 2, 6
"""Keyframes that observe an established landmark, and from how many on all count alike."""
_MIN_KEPT_RATIO = 0.5
"""When fewer of them agree, the established landmarks show no motion."""
_LEAST_OTHERS, _LEAST_OTHER_RATIO = 20, 0.12
"""Pairs that show another motion, in number and as a share of all. Mismatches agree on none;
the upper and the lower rows of a rolling shutter gave 0.10."""
_WIDER = 1.5
"""Another motion is the camera's if its features lie this much farther apart."""
_WIDE = 0.8
"""Another motion may be the camera's if its features lie this far apart, relative to all: features on a
passer-by give 0.1 to 0.5."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """Pose by pairs of points and features of which some may move by themselves.

    Attributes:
        T_camera_world: (4, 4).
        agree: (M,) which pairs agree with it.
        moving: (M,) which pairs contradict it while another motion is in view; none if there is no other.
        doubts: Why it may be the motion of something else.
    """

    T_camera_world: Transform
    agree: NDArray[np.bool_]
    moving: NDArray[np.bool_]
    doubts: tuple[Doubt, ...] = ()


def camera_motion(
    T_camera_world: Transform,
    points_world: Points,
    observation: ImageObservation,
    features: NDArray[np.integer],
    observers: NDArray[np.integer],
    weights: Array,
) -> CameraMotion:
    """Return the pose that established landmarks agree with, unless a wider part of the scene contradicts.

    Things that move are small beside the scene they move in. So where the pairs that contradict a pose agree
    on another one, the motion whose own features lie farther apart is the camera's.

    Args:
        T_camera_world: (4, 4) to begin with.
        points_world: (M, 3) metres.
        observation: The frame.
        features: (M,) the feature of each point.
        observers: (M,) number of keyframes that observe each point, 0 for those that are no landmarks.
        weights: (N, 3) inverse variances of the frame's features by which pairs agree.
    """
    T_found, agree = refined_by_established(
        T_camera_world, points_world, observation, features, observers, weights
    )
    only_motion = CameraMotion(T_found, agree, np.zeros(len(features), np.bool_))
    least = max(_LEAST_OTHERS, _LEAST_OTHER_RATIO * len(features))
    if (~agree).sum() < least:
        return only_motion
    T_other, _ = refined(T_camera_world, points_world[~agree], observation, features[~agree], weights)
    agree_other = agreeing(T_other, points_world, observation, features, weights)
    if (agree_other & ~agree).sum() < least:
        return only_motion
    spread_m = _spread_m(points_world[agree & ~agree_other])
    spread_other_m = _spread_m(points_world[agree_other & ~agree])
    if spread_other_m >= _WIDER * spread_m:
        T_found, agree, agree_other = T_other, agree_other, agree
        spread_other_m = spread_m
    others = int((agree_other & ~agree).sum())
    if spread_other_m < _WIDE * _spread_m(points_world) and others < agree.sum():
        return CameraMotion(T_found, agree, ~agree)
    doubt = Doubt("disagreement", f"{others} of {len(features)} features show another motion")
    return CameraMotion(T_found, agree, ~agree, (doubt,))


def refined_by_established(
    T_camera_world: Transform,
    points_world: Points,
    observation: ImageObservation,
    features: NDArray[np.integer],
    observers: NDArray[np.integer],
    weights: Array,
) -> tuple[Transform, NDArray[np.bool_]]:
    """Return the refined T_camera_world and which pairs agree with it, as established landmarks see it.

    What moves soon contradicts the keyframes that saw it, so landmarks that most keyframes observe stand
    still. The pose is theirs first, and is then refined by all pairs that agree with it: however many
    features a passer-by adds to the view, they have no vote. Arguments as for ``camera_motion``.
    """
    is_established = _established(observers)
    if is_established is not None:
        T_found, agree = refined(
            T_camera_world,
            points_world[is_established],
            observation,
            features[is_established],
            weights,
        )
        if agree.sum() >= _MIN_KEPT_RATIO * len(agree):
            agree = agreeing(T_found, points_world, observation, features, weights)
            T_found, _ = refined(T_found, points_world[agree], observation, features[agree], weights)
            return T_found, agreeing(T_found, points_world, observation, features, weights)
    T_found, _ = refined(T_camera_world, points_world, observation, features, weights)
    return T_found, agreeing(T_found, points_world, observation, features, weights)


def agreeing(
    T_camera_world: Transform,
    points_world: Points,
    observation: ImageObservation,
    features: NDArray[np.integer],
    weights: Array,
) -> NDArray[np.bool_]:
    """Return (M,) which points lie where their features are, by the 95 % test of χ²."""
    agree = np.empty(len(features), np.bool_)
    classify(
        T_camera_world,
        points_world,
        observation.measured[features],
        weights[features],
        observation.intrinsics,
        agree,
    )
    return agree


def _established(observers: NDArray[np.integer]) -> NDArray[np.bool_] | None:
    """Return which landmarks have most observers, as many as are needed; None if there are too few."""
    if len(observers) < _ENOUGH_ESTABLISHED:
        return None
    least = np.partition(np.minimum(observers, _MOST_OBSERVERS), -_ENOUGH_ESTABLISHED)[-_ENOUGH_ESTABLISHED]
    return None if least < _LEAST_OBSERVERS else observers >= least


def _spread_m(points: Points) -> float:
    """Return the median distance of points from their median; 0 without points."""
    if not len(points):
        return 0.0
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
