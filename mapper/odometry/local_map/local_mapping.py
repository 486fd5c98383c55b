"""Local mapping: a tracked frame becomes a keyframe (Mur-Artal, Montiel & Tardós 2015, §VI)."""

import math
from collections.abc import Sequence
from dataclasses import replace

from mapper.core.geometry import Array, inverse
from mapper.graph.model import BetweenFactor
from mapper.graph.noise import inflated
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.local_map.bundle.log_residuals import LogResiduals
from mapper.odometry.local_map.calibration.calibration_checks import CalibrationChecks
from mapper.odometry.local_map.landmarks.landmark_map import MIN_SHARED_LANDMARKS, LandmarkMap
from mapper.odometry.local_map.pose.assessment import UNDOUBTED, Assessment
from mapper.odometry.local_map.pose.pose_information import (
    disparity_ratio,
    keyframe_residuals,
    relative_information,
)
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose
from mapper.odometry.local_map.pose.triangulation import add_triangulated
from mapper.odometry.local_map.recovery.relocalizer import Relocalizer

_FACTORS_PER_KEYFRAME = 4
"""Factors of each keyframe, to the earlier ones that share most landmarks with it."""


class LocalMapping:
    """Extension of the local map by keyframes, and the factors between them."""

    def __init__(
        self,
        config: KeyframeOdometryConfig,
        landmark_map: LandmarkMap,
        relocalizer: Relocalizer,
        calibration: CalibrationChecks,
    ) -> None:
        self._config = config
        self._map = landmark_map
        self._relocalizer = relocalizer
        self._calibration = calibration
        self._still_keyframes = config.bundle_keyframes  # the newest ones, in which few features move
        self.residuals = LogResiduals(disparity_sigma=config.disparity_sigma_px)

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
            tracked_pose: The frame.
            neighbour: Keyframe of the sub-map in which it was tracked; None begins a new one.
            twist_camera: (6,) velocity of the camera in its own axes, rad/s and m/s.
            assessed: Doubts about its pose.
        """
        config, observation = self._config, tracked_pose.observation
        # A measured noise is taken as it is; where much moves, more weight would prefer passers-by's motion.
        if config.depth_noise is None and tracked_pose.few_move:
            observation = observation.with_disparity_sigma(self.residuals.disparity_sigma)
        is_new = observation.has_depth & (tracked_pose.landmark_of_feature < 0)
        is_new[tracked_pose.moving] = False
        index = self._map.add_keyframe(
            observation,
            tracked_pose.T_camera_world,
            tracked_pose.landmark_of_feature,
            new=is_new,
            neighbour=neighbour,
            twist_camera=twist_camera,
            depth_information=None if tracked_pose.depth is None else tracked_pose.depth.lasting_information,
        )
        if config.triangulate and tracked_pose.few_move:  # without depth nothing shows what moves
            add_triangulated(self._map, index, except_for=tracked_pose.moving)
        self._relocalizer.add(index)
        self._refine_map(index, few_move=tracked_pose.few_move)
        keyframe = self._map.keyframes[index]
        keyframe.doubt_rad, keyframe.doubt_m = assessed.sigma_rad, assessed.sigma_m
        return replace(
            tracked_pose,
            observation=self._map.observation(index),
            T_camera_world=keyframe.T_camera_world,
            landmark_of_feature=self._map.landmark_of_feature(index),
            reference=index,
        )

    def _refine_map(self, index: int, *, few_move: bool) -> None:
        """Adjust the map around the newest keyframe, cull landmarks, and learn from its residuals."""
        window = self._config.bundle_keyframes
        self._still_keyframes = self._still_keyframes + 1 if few_move else 0
        variance_factor = self.residuals.variance_factor if self._still_keyframes >= window else 1.0
        self._map.refine(index, window=window, variance_factor=variance_factor)
        self._map.follow_readout()
        self._map.cull()
        self._calibration.pass_keyframe()
        if (statistics := keyframe_residuals(self._map, index)) is not None:
            self.residuals.add(statistics)
            self._map.residual_variance = self.residuals.variance
        if (ratio := disparity_ratio(self._map, index)) is not None:
            self.residuals.add_disparity_ratio(ratio)

    def factor(self, i: int, j: int, *, shared_by: int = 1) -> BetweenFactor:
        """Return the relative pose of two keyframes in the current map.

        ``shared_by`` factors of j rest largely on the same features. Were these the same, each factor would
        have that share of their information, were they others, all: it has the geometric mean.
        """
        keyframes = self._map.keyframes
        T_i_j = inverse(keyframes[i].body_pose) @ keyframes[j].body_pose
        information = relative_information(self._map, i, j)
        information = self.residuals.rescaled(information, T_i_j) / math.sqrt(shared_by)
        if (doubt_m := keyframes[j].doubt_m) > 0.0:
            information = inflated(information, sigma_rad=keyframes[j].doubt_rad, sigma_m=doubt_m)
        return BetweenFactor(i, j, T_i_j, information)

    def factors(self) -> Sequence[BetweenFactor]:
        """Return a factor from every keyframe to those earlier ones that share most landmarks with it.

        The first keyframe of a sub-map has none, as its pose in other sub-maps is unknown.
        """
        factors = []
        for j, keyframe in enumerate(self._map.keyframes):
            self._map.step()
            if j == keyframe.origin:
                continue
            earlier = [(k, shared) for k, shared in self._map.covisible(j, min_shared=1) if k < j]
            strong = [k for k, shared in earlier if shared >= MIN_SHARED_LANDMARKS]
            weak = [k for k, _ in earlier[:1]] or [self._map.previous(j)]
            linked = [keyframe.depth_link.reference] if keyframe.depth_link is not None else []
            targets = dict.fromkeys([*(strong[:_FACTORS_PER_KEYFRAME] or linked or weak), *linked])
            factors += [self.factor(i, j, shared_by=len(targets)) for i in targets]
        return factors
