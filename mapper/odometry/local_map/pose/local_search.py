"""Local map search: landmarks of covisible keyframes are matched near their projections."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform, apply
from mapper.features.hamming import Bits
from mapper.features.window_matching import GridFeatures, SearchWindows, match_windows
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.local_map.depth.earlier_depth import EarlierDepth, hidden_points
from mapper.odometry.local_map.landmarks.landmark_kernels import project_visible
from mapper.odometry.local_map.landmarks.landmark_map import Ids, LandmarkMap
from mapper.odometry.local_map.observation.image_observation import ImageObservation
from mapper.odometry.local_map.pose.camera_motion import refined_by_established
from mapper.odometry.local_map.pose.pose_tracker import MAX_HAMMING, TrackedPose, refined, rms_px
from mapper.odometry.local_map.pose.triangulation import weights_with_landmarks

_MAX_RATIO = 0.8
_CHANCE = 0.02
"""Largest share of the landmarks in view that match and agree with a wrong pose by chance."""
_CHANCE_SIGMAS = 5.0


def least_by_chance(visible: int) -> int:
    """Return how many inliers a wrong pose hardly has: the binomial's mean and five standard deviations."""
    mean = _CHANCE * visible
    return math.ceil(mean + _CHANCE_SIGMAS * math.sqrt(mean * (1.0 - _CHANCE)))


class PredictedFeatures(NamedTuple):
    """Features that are predicted in a frame.

    Attributes:
        pixels: (M, 2) when the middle row is read.
        depth_m: (M,).
        octave: (M,) int32.
        bits: (M, 4) uint64 descriptors.
    """

    pixels: Array
    depth_m: Array
    octave: NDArray[np.int32]
    bits: Bits


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
        agreement: float,
        method: str,
        is_moving: NDArray[np.bool_] | None = None,
    ) -> TrackedPose | None:
        """Search the landmarks of the most covisible keyframes and refine the pose with all that match.

        Args:
            observation: The frame.
            T_camera_world: (4, 4) first pose, good to a few pixels.
            landmark_of_feature: (N,) landmark of each feature matched so far, −1 for none.
            reference: Keyframe to search if no feature is matched.
            agreement: Share of the first matches that agree with it.
            method: Step that found the first pose, for ``TrackedPose.method``.
            is_moving: (N,) features that are known to move by themselves; None if none is.

        Returns:
            The refined pose; None if too few landmarks agree.
        """
        landmarks = self._map.landmarks
        moved = self._earlier_depth.moved(observation, T_camera_world, reference)
        if is_moving is not None:
            moved |= is_moving
            observation = observation.among_moving(is_moving)
        landmark_of_feature = np.where(moved, -1, landmark_of_feature).astype(np.int32)
        matched = landmark_of_feature[landmark_of_feature >= 0]
        keyframes = self._covisible(matched) or [reference]
        visible, predicted = self._visible(observation, T_camera_world, keyframes, except_for=matched)
        feature = self.match_near(
            observation,
            predicted,
            search_px=self._config.local_search_px,
            taken=moved | (landmark_of_feature >= 0),
            max_ratio=_MAX_RATIO,
        )
        hits = np.flatnonzero(feature >= 0)
        landmark_of_feature[feature[hits]] = visible[hits]
        features = np.flatnonzero(landmark_of_feature >= 0)
        ids = landmark_of_feature[features]
        if len(features) < self._config.min_inliers:
            return None
        T_camera_world, agree = self._refined_pose(observation, T_camera_world, features, ids, moved)
        in_view = len(visible) + len(matched)
        if agree.sum() < max(self._config.min_inliers, least_by_chance(in_view)):
            hidden = hidden_points(observation, T_camera_world, landmarks["position"][visible])
            shown = in_view - int(hidden.sum())
            if agree.sum() < max(self._config.min_inliers, least_by_chance(shown)):
                return None
        landmark_of_feature[features[~agree]] = -1
        landmarks["visible"][visible] += 1
        landmarks["visible"][matched] += 1
        landmarks["found"][ids[agree]] += 1
        return TrackedPose(
            observation,
            T_camera_world,
            landmark_of_feature,
            keyframes[0],
            len(features),
            agreement,
            in_view,
            rms_px(T_camera_world, landmarks["position"][ids[agree]], observation, features[agree]),
            method,
            moving=np.flatnonzero(moved).astype(np.int32),
        )

    def missing_in_view(self, tracked_pose: TrackedPose) -> Array:
        """Return (M, 2) pixels of the landmarks that a pose has in view but that no feature agrees with.

        Those that the depth image hides are left out.
        """
        observation, T_camera_world = tracked_pose.observation, tracked_pose.T_camera_world
        matched = tracked_pose.landmark_of_feature[tracked_pose.landmark_of_feature >= 0]
        keyframes = self._covisible(matched) or [tracked_pose.reference]
        visible, predicted = self._visible(observation, T_camera_world, keyframes, except_for=matched)
        hidden = hidden_points(observation, T_camera_world, self._map.landmarks["position"][visible])
        return predicted.pixels[~hidden]

    def _covisible(self, landmarks: Ids) -> list[int]:
        """Return the keyframes that observe any of the landmarks, in decreasing order of how many."""
        counts = self._map.shared_counts(landmarks)
        observing = np.flatnonzero(counts)
        order: list[int] = observing[np.argsort(-counts[observing], kind="stable")].tolist()
        return order

    def _visible(
        self,
        observation: ImageObservation,
        T_camera_world: Transform,
        keyframes: Sequence[int],
        *,
        except_for: Ids,
    ) -> tuple[Ids, PredictedFeatures]:
        """Return the (M,) landmarks of the first keyframes that a pose has in the image, as it has them."""
        config, landmarks = self._config, self._map.landmarks
        nearby = self._map.landmarks_of_any(keyframes[: config.local_keyframes], except_for=except_for)
        rows, pixels, octave = project_visible(
            landmarks["position"][nearby],
            landmarks["direction"][nearby],
            landmarks["reach_m"][nearby],
            T_camera_world,
            observation.intrinsics,
            np.array(observation.size_px),
            math.log(self._map.scale_factor),
            config.detector.levels,
        )
        visible = nearby[rows]
        depth_m = apply(T_camera_world, landmarks["position"][visible])[:, 2]
        return visible, PredictedFeatures(pixels, depth_m, octave, landmarks["bits"][visible])

    def _refined_pose(
        self,
        observation: ImageObservation,
        T_camera_world: Transform,
        features: NDArray[np.integer],
        ids: Ids,
        moved: NDArray[np.bool_],
    ) -> tuple[Transform, NDArray[np.bool_]]:
        """Return the T_camera_world that most matches agree on, refined by these, and which they are."""
        landmarks, found = self._map.landmarks, (T_camera_world, observation, features, ids)
        T_camera_world, agree = refined_by_established(
            T_camera_world,
            landmarks["position"][ids],
            observation,
            features,
            landmarks["observers"][ids],
            weights_with_landmarks(self._map, *found, observation.weights_among(moved)),
        )
        T_camera_world, _ = refined(
            T_camera_world,
            landmarks["position"][ids[agree]],
            observation,
            features[agree],
            weights_with_landmarks(self._map, *found, observation.weights),
        )
        return T_camera_world, agree

    def match_near(
        self,
        observation: ImageObservation,
        predicted: PredictedFeatures,
        *,
        search_px: float,
        taken: NDArray[np.bool_],
        max_ratio: float,
    ) -> Ids:
        """Return, per predicted feature, the matching one or −1. The radius grows with the octave."""
        pixels, depth_m, octave, bits = predicted
        if observation.sweep_camera.any():
            pixels = pixels + observation.row_shift(pixels, depth_m)
        radius_px = search_px * self._map.scale_factor ** octave.astype(np.float64)
        matched: Ids = match_windows(
            SearchWindows(pixels, radius_px, octave, bits),
            GridFeatures(observation.pixels, observation.octave, observation.bits, observation.grid),
            taken,
            MAX_HAMMING,
            max_ratio,
        )
        return matched
