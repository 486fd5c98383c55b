"""Local mapping: the map around keyframes, and the factors between them."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapper.core.geometry import Array, Transform, inverse
from mapper.core.running_median import RunningMedian
from mapper.graph.measurement_covariance import inflated, with_model_error
from mapper.graph.model import BetweenFactor
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.keyframes.focal_length import WINDOW_KEYFRAMES, FocalLengthCheck
from mapper.odometry.keyframes.frame_doubts import UNDOUBTED, Assessment
from mapper.odometry.keyframes.landmarks import MIN_SHARED_LANDMARKS, LandmarkMap
from mapper.odometry.keyframes.pose_tracker import TrackedPose
from mapper.odometry.keyframes.relocalizer import Relocalizer
from mapper.registration.reprojection import ResidualStatistics

_FACTORS_PER_KEYFRAME = 4
"""Factors of each keyframe, to the earlier ones that share most landmarks with it."""

_MIN_KEYFRAMES = 5
"""With fewer keyframes, features count as their weights say, with the whole model error."""
_NO_EFFECT, _FULL_EFFECT = 1.0, 1.5
"""Design effects at which residuals show no model error, and all of it. Synthetic logs without errors of
calibration have 0.75 to 1.0, real and uncalibrated ones 1.5 to 2.3."""
_MIN_MODEL_ERROR = 0.125
"""Share of the model error that is always added."""


class LocalMapping:
    """Local mapping (Mur-Artal, Montiel & Tardós 2015, §VI): keyframes, bundle adjustment, culling."""

    def __init__(
        self, config: KeyframeOdometryConfig, landmark_map: LandmarkMap, relocalizer: Relocalizer
    ) -> None:
        self._config = config
        self._map = landmark_map
        self._relocalizer = relocalizer
        self._residuals = LogResiduals()
        self._focal_length = FocalLengthCheck()

    def add_keyframe(
        self,
        tracked_pose: TrackedPose,
        *,
        neighbour: int | None,
        twist_camera: Array,
        assessed: Assessment = UNDOUBTED,
    ) -> TrackedPose:
        """Turn a tracked frame into a keyframe, refine the map around it, and return its refined pose.

        Args:
            tracked_pose: Pose of the frame, with its landmarks.
            neighbour: Keyframe of the sub-map in which it was tracked; None begins a new one.
            twist_camera: (6,) velocity of the camera in its own axes, rad/s and m/s.
            assessed: Doubts about the pose.
        """
        observation = tracked_pose.observation
        is_new = observation.has_depth & (tracked_pose.landmark_of_feature < 0)
        is_new[tracked_pose.moving] = False
        index = self._map.add_keyframe(
            observation,
            tracked_pose.T_camera_world,
            tracked_pose.landmark_of_feature,
            new=is_new,
            neighbour=neighbour,
            twist_camera=twist_camera,
            depth_information=None if tracked_pose.depth is None else tracked_pose.depth.information,
        )
        self._relocalizer.add(index)
        self._map.refine(index, window=self._config.bundle_keyframes)
        self._map.follow_readout()
        self._map.cull()
        self._check_focal_length()
        if (statistics := self._map.residual_statistics(index)) is not None:
            self._residuals.add(statistics)
        keyframe = self._map.keyframes[index]
        keyframe.doubt_rad, keyframe.doubt_m = assessed.sigma_rad, assessed.sigma_m
        return replace(
            tracked_pose,
            observation=self._map.observation(index),
            T_camera_world=keyframe.T_camera_world,
            landmark_of_feature=keyframe.landmark_of_feature,
            reference=index,
        )

    def factor(self, i: int, j: int, *, shared_by: int = 1) -> BetweenFactor:
        """Return the relative pose of two keyframes in the current map.

        ``shared_by`` factors of j rest largely on the same features. Were these the same, each factor would
        have that share of their information, were they others, all: it has the geometric mean.
        """
        keyframes = self._map.keyframes
        T_i_j = inverse(keyframes[i].body_pose) @ keyframes[j].body_pose
        information = self._map.information(i, j) + self._map.depth_information(i, j)
        information = self.rescale(information, T_i_j) / math.sqrt(shared_by)
        doubtful = self._map.keyframes[j]
        if doubtful.doubt_m > 0.0:
            information = inflated(information, sigma_rad=doubtful.doubt_rad, sigma_m=doubtful.doubt_m)
        return BetweenFactor(i, j, T_i_j, information)

    def factors(self) -> Sequence[BetweenFactor]:
        """Return a factor from every keyframe to those earlier ones that share most landmarks with it.

        The first keyframe of a sub-map has none, as its pose in other sub-maps is unknown.
        """
        factors = []
        for j, keyframe in enumerate(self._map.keyframes):
            if j == keyframe.origin:
                continue
            earlier = [(k, shared) for k, shared in self._map.covisible(j, min_shared=1) if k < j]
            strong = [k for k, shared in earlier if shared >= MIN_SHARED_LANDMARKS]
            weak = [k for k, _ in earlier[:1]] or [self._map.previous(j)]
            linked = [keyframe.depth_link.reference] if keyframe.depth_link is not None else []
            targets = dict.fromkeys([*(strong[:_FACTORS_PER_KEYFRAME] or linked or weak), *linked])
            factors += [self.factor(i, j, shared_by=len(targets)) for i in targets]
        return factors

    def rescale(self, information: Array, T_i_j: Transform) -> Array:
        """Return the (6, 6) information of a relative pose as the residuals of the log show it."""
        return self._residuals.rescale(information, T_i_j)

    def calibration_warnings(self) -> Sequence[str]:
        """Return whether the images contradict the focal length that they are said to have."""
        if not self._map.keyframes:
            return ()
        sentence = self._focal_length.contradiction(self._map.observation(0).intrinsics[0])
        return (sentence,) if sentence else ()

    def _check_focal_length(self) -> None:
        """Check the newest keyframes of a sub-map together, once there are enough since the last check."""
        newest = range(len(self._map.keyframes) - WINDOW_KEYFRAMES, len(self._map.keyframes))
        origins = {self._map.keyframes[k].origin for k in newest if k >= 0}
        if len(self._map.keyframes) % WINDOW_KEYFRAMES or len(origins) > 1 or self._focal_length.is_complete:
            return
        self._focal_length.add(self._map.bundle(newest))


class LogResiduals:
    """Medians of the keyframes' residual statistics.

    Errors of calibration, shutter and depth move neighbouring features alike, so residuals that depend on
    each other tell how much of such errors a log has.
    """

    def __init__(self) -> None:
        self._variance_factor = RunningMedian(memory=None, fewest=_MIN_KEYFRAMES)
        self._design_effect = RunningMedian(memory=None, fewest=_MIN_KEYFRAMES)

    def add(self, keyframe: ResidualStatistics) -> None:
        """Add a keyframe's."""
        self._variance_factor.add(keyframe.variance_factor)
        self._design_effect.add(keyframe.design_effect)

    def rescale(self, information: Array, T_i_j: Transform) -> Array:
        """Return the (6, 6) information of a relative pose by what the residuals show.

        Args:
            information: (6, 6) from features whose errors are independent, and as large as their weights say.
            T_i_j: (4, 4) the measurement.
        """
        if not self._variance_factor.is_known:
            return with_model_error(information, T_i_j)
        share = (self._design_effect.median - _NO_EFFECT) / (_FULL_EFFECT - _NO_EFFECT)
        model_error = float(np.clip(share, _MIN_MODEL_ERROR, 1.0))
        return with_model_error(information / self._variance_factor.median, T_i_j, scale=model_error)
