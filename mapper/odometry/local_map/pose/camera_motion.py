"""Motion of the camera among several motions in an image, such as those of passers-by."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapper.core.doubts import Doubt
from mapper.core.geometry import Array, Points, Transform
from mapper.odometry.local_map.observation.image_observation import ImageObservation
from mapper.odometry.local_map.pose.pose_tracker import refined
from mapper.odometry.local_map.pose.sampled_poses import sampled_pose, shares_of_scene, support
from mapper.registration.reprojection import classify

_ENOUGH_ESTABLISHED = 30
"""Landmarks that determine which motion is the camera's."""
_LEAST_OBSERVERS, _MOST_OBSERVERS = 2, 6
"""Keyframes that observe an established landmark, and from how many on all count the same."""
_MOST_CONTRADICT = 1.0 / 3.0
"""While fewer contradict the pose of established landmarks, it is not compared with that of all pairs."""
_CLEARLY = 1.05
"""Another pose is the camera's if it explains so many times as much of the scene: with 1.0 to 1.1 as many of
the frames of nine crowds are right, to 4 %."""
_ENOUGH_PAIRS, _FITS = 80, 0.8
"""Pairs from which on samples are drawn, unless a larger share of them fits as well as is usual for the log:
of a few pairs, as over a wide baseline, many are mismatches."""
_LEAST_OTHERS, _LEAST_OTHER_RATIO = 20, 0.12
"""Pairs that show another motion, in number and as a share of all. Mismatches agree on none;
the upper and the lower rows of a rolling shutter gave 0.10."""
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
    variance: float,
) -> CameraMotion:
    """Return the pose that established landmarks agree with, unless another one explains more of the scene.

    Things that move are small beside the scene they move in, however many features they have. The other poses
    are those of samples of the pairs and of the pairs that contradict.

    Args:
        T_camera_world: (4, 4) to begin with.
        points_world: (M, 3) metres.
        observation: The frame.
        features: (M,) the feature of each point.
        observers: (M,) number of keyframes that observe each point, 0 for those that are no landmarks.
        weights: (N, 3) inverse variances of the frame's features by which pairs agree.
        variance: Usual square of residuals, relative to that of the weights. Pixels are found better than
            that, so that a compromise between still walls and someone near by, whose features all pass the
            test, has residuals that are too large.
    """
    T_found, agree = refined_by_established(
        T_camera_world, points_world, observation, features, observers, weights, variance
    )
    fitted = _fitted(weights, variance)
    scene = _Scene(points_world, observation, features, fitted)
    fits = agreeing(T_found, points_world, observation, features, fitted)
    if len(fits) >= _ENOUGH_PAIRS and fits.mean() < _FITS:
        T_found = scene.most_supported([T_found, scene.sampled_pose(T_camera_world)])
        agree = agreeing(T_found, points_world, observation, features, weights)
    only_motion = CameraMotion(T_found, agree, np.zeros(len(features), np.bool_))
    least = max(_LEAST_OTHERS, _LEAST_OTHER_RATIO * len(features))
    if (~agree).sum() < least:
        return only_motion
    T_other, _ = refined(T_camera_world, points_world[~agree], observation, features[~agree], weights)
    agree_other = agreeing(T_other, points_world, observation, features, weights)
    if (agree_other & ~agree).sum() < least:
        return only_motion
    if scene.most_supported([T_found, T_other]) is T_other:
        T_found, agree, agree_other = T_other, agree_other, agree
    is_other = agree_other & ~agree
    if _spread_m(points_world[is_other]) < _WIDE * _spread_m(points_world) and is_other.sum() < agree.sum():
        return CameraMotion(T_found, agree, ~agree)
    doubt = Doubt("another motion", f"{int(is_other.sum())} of {len(features)} features show another motion")
    return CameraMotion(T_found, agree, ~agree, (doubt,))


def refined_by_established(
    T_camera_world: Transform,
    points_world: Points,
    observation: ImageObservation,
    features: NDArray[np.integer],
    observers: NDArray[np.integer],
    weights: Array,
    variance: float = 1.0,
) -> tuple[Transform, NDArray[np.bool_]]:
    """Return the refined T_camera_world and which pairs agree with it, by established landmarks first.

    What moves soon contradicts the keyframes that saw it, so landmarks that most keyframes observe stand
    still. The pose is theirs first, and is then refined by all pairs that agree with it: however many
    features a passer-by adds to the view, they have no weight. Where many contradict it, it is compared with
    the pose of all pairs. Arguments as for ``camera_motion``; by default the weights are taken as they are.
    """
    is_established = _established(observers)
    fitted = _fitted(weights, variance)
    poses = []
    if is_established is not None:
        T_found, _ = refined(
            T_camera_world,
            points_world[is_established],
            observation,
            features[is_established],
            fitted,
        )
        agree = agreeing(T_found, points_world, observation, features, weights)
        contradict = float((~agree).mean())
        T_found, _ = refined(T_found, points_world[agree], observation, features[agree], fitted)
        if contradict <= _MOST_CONTRADICT:
            return T_found, agreeing(T_found, points_world, observation, features, weights)
        poses.append(T_found)
    T_found, _ = refined(T_camera_world, points_world, observation, features, fitted)
    poses.append(T_found)
    T_found = _Scene(points_world, observation, features, fitted).most_supported(poses)
    return T_found, agreeing(T_found, points_world, observation, features, weights)


def _fitted(weights: Array, variance: float) -> Array:
    """Return the (N, 3) weights by which poses are fitted.

    However well pixels are found, depth has the errors of its sensor.
    """
    fitted: Array = weights / np.array([variance, variance, 1.0])
    return fitted


class _Scene:
    """The matched part of a scene, and how much of it poses explain."""

    def __init__(
        self,
        points_world: Points,
        observation: ImageObservation,
        features: NDArray[np.integer],
        weights: Array,
    ) -> None:
        measured = observation.measured[features]
        self._pairs = points_world, measured, weights[features], observation.intrinsics

    @cached_property
    def _shares(self) -> Array:
        return shares_of_scene(self._pairs[0])

    def sampled_pose(self, T_camera_world: Transform) -> Transform:
        """Return the pose by samples, which begin with a (4, 4) pose."""
        return sampled_pose(T_camera_world, *self._pairs, self._shares)

    def most_supported(self, poses: Sequence[Transform]) -> Transform:
        """Return the first pose unless another one explains clearly more of the scene."""
        if len(poses) == 1:
            return poses[0]
        gains = np.array([support(T, *self._pairs, self._shares) for T in poses])
        gains[0] *= _CLEARLY
        return poses[int(np.argmax(gains))]


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
