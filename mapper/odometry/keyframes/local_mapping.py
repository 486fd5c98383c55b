"""Local mapping: the map around keyframes, and the factors between them."""

import math
from collections.abc import Sequence
from dataclasses import replace

from mapper.core.geometry import Array, inverse
from mapper.graph.measurement_covariance import inflated, with_model_error
from mapper.graph.model import BetweenFactor
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.keyframes.focal_length import WINDOW_KEYFRAMES, FocalLengthCheck
from mapper.odometry.keyframes.frame_doubts import UNDOUBTED, Assessment
from mapper.odometry.keyframes.landmarks import MIN_SHARED_LANDMARKS, LandmarkMap
from mapper.odometry.keyframes.pose_tracker import TrackedPose
from mapper.odometry.keyframes.relocalizer import Relocalizer

_FACTORS_PER_KEYFRAME = 4
"""Factors of each keyframe, to the earlier ones that share most landmarks with it."""


class LocalMapping:
    """Local mapping (Mur-Artal, Montiel & Tardós 2015, §VI): keyframes, bundle adjustment, culling."""

    def __init__(
        self, config: KeyframeOdometryConfig, landmark_map: LandmarkMap, relocalizer: Relocalizer
    ) -> None:
        self._config = config
        self._map = landmark_map
        self._relocalizer = relocalizer
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
        information = with_model_error(information, T_i_j) / math.sqrt(shared_by)
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
