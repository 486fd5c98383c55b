"""Local map search: landmarks of covisible keyframes are matched near their projections."""

import math

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform, apply
from mapper.features.hamming import MAX_HAMMING, Bits
from mapper.features.window_matching import GridFeatures, SearchWindows, match_windows
from mapper.odometry.camera.image_observation import ImageObservation
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.keyframes.depth_comparison import EarlierDepth
from mapper.odometry.keyframes.landmark_kernels import project_visible
from mapper.odometry.keyframes.landmarks import Ids, LandmarkMap
from mapper.odometry.keyframes.motion_segmentation import refined_by_established
from mapper.odometry.keyframes.pose_tracker import TrackedPose, rms_px

_MAX_RATIO = 0.8
_RADIUS_PX = 4.0
"""Search radius around projected landmarks in the finest octave."""
_CHANCE = 0.02
"""Largest share of the landmarks in view that match and agree with a wrong pose by chance."""
_CHANCE_SIGMAS = 5.0


def least_by_chance(visible: int) -> int:
    """Return how many inliers a wrong pose hardly has: the binomial's mean and five standard deviations."""
    mean = _CHANCE * visible
    return math.ceil(mean + _CHANCE_SIGMAS * math.sqrt(mean * (1.0 - _CHANCE)))


class LocalSearch:
    """Search for the landmarks of the keyframes around a first pose."""

    def __init__(self, config: KeyframeOdometryConfig, landmark_map: LandmarkMap) -> None:
        self._config = config
        self._map = landmark_map
        self._earlier_depth = EarlierDepth(landmark_map, config.depth_noise)

    def refine(
        self,
        observation: ImageObservation,
        T_camera_world: Transform,
        landmark_of_feature: Ids,
        *,
        reference: int,
        method: str,
    ) -> TrackedPose | None:
        """Search the landmarks of the most covisible keyframes and refine the pose with all that match.

        Args:
            observation: The frame.
            T_camera_world: (4, 4) first pose, good to a few pixels.
            landmark_of_feature: (N,) landmark of each feature matched so far, −1 for none.
            reference: Keyframe to search if no feature is matched.
            method: Step that found the first pose, for ``TrackedPose.method``.

        Returns:
            The refined pose; None if too few landmarks agree.
        """
        config, landmarks = self._config, self._map.landmarks
        moved = self._earlier_depth.moved(observation, T_camera_world, reference)
        landmark_of_feature = np.where(moved, -1, landmark_of_feature).astype(np.int32)
        matched = landmark_of_feature[landmark_of_feature >= 0]
        counts = self._map.shared_counts(matched)
        order = [int(k) for k in np.argsort(-counts, kind="stable") if counts[k] > 0] or [reference]
        nearby = self._map.landmarks_of_any(order[: config.local_keyframes], except_for=matched)
        rows, pixels, octave = project_visible(
            nearby,
            landmarks["position"],
            landmarks["direction"],
            landmarks["reach_m"],
            T_camera_world,
            observation.intrinsics,
            np.array(observation.size_px),
            math.log(self._map.scale_factor),
            config.detector.levels,
        )
        visible = nearby[rows]
        feature = self.match_near(
            observation,
            pixels,
            apply(T_camera_world, landmarks["position"][visible])[:, 2],
            octave,
            landmarks["bits"][visible],
            search_px=_RADIUS_PX,
            taken=moved | (landmark_of_feature >= 0),
            max_ratio=_MAX_RATIO,
        )
        hits = np.flatnonzero(feature >= 0)
        landmark_of_feature[feature[hits]] = visible[hits]
        features = np.flatnonzero(landmark_of_feature >= 0)
        ids = landmark_of_feature[features]
        if len(features) < config.min_inliers:
            return None
        T_camera_world, agree = refined_by_established(
            T_camera_world,
            landmarks["position"][ids],
            observation,
            features,
            landmarks["observers"][ids],
            observation.weights_among(moved),
        )
        if agree.sum() < max(config.min_inliers, least_by_chance(len(visible) + len(matched))):
            return None
        landmark_of_feature[features[~agree]] = -1
        landmarks["visible"][visible] += 1
        landmarks["visible"][matched] += 1
        landmarks["found"][ids[agree]] += 1
        return TrackedPose(
            observation,
            T_camera_world,
            landmark_of_feature,
            order[0],
            len(features),
            len(visible) + len(matched),
            rms_px(T_camera_world, landmarks["position"][ids[agree]], observation, features[agree]),
            method,
            moving=np.flatnonzero(moved).astype(np.int32),
        )

    def match_near(
        self,
        observation: ImageObservation,
        pixels: Array,
        depth_m: Array,
        octave: NDArray[np.int32],
        bits: Bits,
        *,
        search_px: float,
        taken: NDArray[np.bool_],
        max_ratio: float,
    ) -> Ids:
        """Return, per pixel and depth predicted for the middle row's time, the matching feature or −1.

        The radius grows with the octave.
        """
        if observation.sweep_camera.any():
            pixels = pixels + observation.line_shift(pixels, depth_m)
        matched: Ids = match_windows(
            SearchWindows(
                pixels, search_px * self._map.scale_factor ** octave.astype(np.float64), octave, bits
            ),
            GridFeatures(observation.pixels, observation.octave, observation.bits, observation.grid),
            taken,
            MAX_HAMMING,
            max_ratio,
        )
        return matched
