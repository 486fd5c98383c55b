"""Relocaliser: the pose of a frame by descriptors alone, without a prediction, after a jump or a loss."""

from collections.abc import Callable, Iterable

import numpy as np

from mapper.core.geometry import Array, Points
from mapper.features.hamming import MAX_HAMMING, Bits, match_mutual_bits
from mapper.odometry.camera.image_observation import ImageObservation
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.keyframes.landmarks import Ids, LandmarkMap
from mapper.odometry.keyframes.local_search import LocalSearch
from mapper.odometry.keyframes.pose_tracker import (
    WEAK_INLIERS,
    TrackedPose,
    refined,
    unmatched,
)
from mapper.places.index import PlaceIndex, match_by_word
from mapper.places.vocabulary import Vocabulary
from mapper.registration.reprojection import ransac_p3p

_MAX_RATIO = 0.85
_CANDIDATES = 5
"""The most similar keyframes, and the nearest, that a lost frame is compared with."""
_MIN_AGREEMENT_RATIO = 0.3
"""Least share of the matches that agree with a pose: repeated structure gave 0.28."""
_MATCHING_LEVEL = 2
"""Only descriptors under one node this many steps below the vocabulary's root are compared (Zhao et al. 2020,
§1.1): the toolkit's own vocabulary has 169 such nodes, so that a frame has a few features under each."""


class Relocalizer:
    """Search for a frame's pose among the keyframes: candidates by visual words, pose by P3P."""

    def __init__(
        self, config: KeyframeOdometryConfig, landmark_map: LandmarkMap, vocabulary: Vocabulary
    ) -> None:
        self._config = config
        self._map = landmark_map
        self._search = LocalSearch(config, landmark_map)
        self._vocabulary = vocabulary
        self._index = PlaceIndex(vocabulary)

    def add(self, keyframe: int) -> None:
        """Add a keyframe to the index of places."""
        words = self._map.observation(keyframe).words
        self._index.add(keyframe, self._vocabulary.vector(words))

    def best_among(
        self,
        keyframes: Iterable[int],
        observation: ImageObservation,
        *,
        method: str,
        is_possible: Callable[[TrackedPose], bool] | None = None,
        exhaustive: bool = False,
    ) -> TrackedPose | None:
        """Return the first pose that many landmarks agree with, else that of most inliers; None if not found.

        A pose of few inliers may be wrong: repeated structure has led to a hundred inliers metres away.
        """
        best: TrackedPose | None = None
        for k in keyframes:
            tracked_pose = self._match_keyframe(k, observation, method=method, exhaustive=exhaustive)
            if tracked_pose is None or not (is_possible is None or is_possible(tracked_pose)):
                continue
            if best is None or tracked_pose.inliers > best.inliers:
                best = tracked_pose
                if best.inliers >= WEAK_INLIERS:
                    break
        return best

    def match_points(
        self,
        observation: ImageObservation,
        bits: Bits,
        points_world: Points,
        landmarks: Ids,
        *,
        reference: int,
        method: str,
    ) -> TrackedPose | None:
        """Match every feature with every point, and find the pose by P3P; None if it is not found.

        Args:
            observation: The frame.
            bits: (M, 4) uint64 descriptors of the points.
            points_world: (M, 3) metres.
            landmarks: (M,) int32 landmark of each point, −1 for none.
            reference: A keyframe that sees the place.
            method: Step for ``TrackedPose.method``.
        """
        pairs = match_mutual_bits(bits, observation.bits, MAX_HAMMING, _MAX_RATIO)
        hits = np.flatnonzero(pairs >= 0)
        return self._pose_of(
            observation, pairs[hits], points_world[hits], landmarks[hits], reference=reference, method=method
        )

    def candidates(self, observation: ImageObservation, position_world: Array) -> list[int]:
        """Return keyframes to match a frame with: the most similar, best first, then the nearest.

        Args:
            observation: The frame.
            position_world: (3,) metres: last known position of the camera.
        """
        words = self._vocabulary.vector(observation.words)
        similar = [k for k, _ in self._index.query(words, min_similarity=0.0, limit=_CANDIDATES)]
        T_camera_world = np.array([keyframe.T_camera_world for keyframe in self._map.keyframes])
        position_camera = T_camera_world[:, :3, :3] @ position_world + T_camera_world[:, :3, 3]
        nearest = np.argsort(np.linalg.norm(position_camera, axis=1), kind="stable")[:_CANDIDATES]
        return list(dict.fromkeys([*similar, *map(int, nearest)]))

    def _match_keyframe(
        self, k: int, observation: ImageObservation, *, method: str, exhaustive: bool
    ) -> TrackedPose | None:
        """Match one keyframe under the vocabulary's nodes, and find the pose by P3P (Zhao et al. 2020, §1.2).

        Levenberg–Marquardt then refines the pose over RANSAC's inliers (ibid., eq. 5–8).
        """
        features, ids = self._matches(k, observation)
        points_world = self._map.landmarks["position"][ids]
        found = self._pose_of(observation, features, points_world, ids, reference=k, method=method)
        if found is not None or not exhaustive:
            return found
        keyframe = self._map.keyframes[k]
        mapped = np.flatnonzero(keyframe.landmark_of_feature >= 0)
        ids = keyframe.landmark_of_feature[mapped]
        return self.match_points(
            observation,
            self._map.observation(k).bits[mapped],
            self._map.landmarks["position"][ids],
            ids,
            reference=k,
            method=method,
        )

    def _pose_of(
        self,
        observation: ImageObservation,
        features: Ids,
        points_world: Points,
        landmarks: Ids,
        *,
        reference: int,
        method: str,
    ) -> TrackedPose | None:
        """Return the pose by P3P, refined over RANSAC's inliers and then with the landmarks around."""
        if len(features) < self._config.min_matches:
            return None
        found = ransac_p3p(
            points_world,
            observation.measured[features, :2],
            observation.intrinsics,
            tolerance_px=self._config.ransac_tolerance_px,
            iterations=self._config.ransac_iterations,
            seed=self._config.ransac_seed,
        )
        if found is None:
            return None
        T_camera_world, agreeing = found
        fewest = max(_MIN_AGREEMENT_RATIO * len(features), self._config.min_matches // 2)
        if len(agreeing) < fewest:
            return None
        features, landmarks = features[agreeing], landmarks[agreeing]
        T_camera_world, agree = refined(T_camera_world, points_world[agreeing], observation, features)
        landmark_of_feature = unmatched(observation)
        landmark_of_feature[features[agree]] = landmarks[agree]
        return self._search.refine(
            observation,
            T_camera_world,
            landmark_of_feature,
            reference=reference,
            method=method,
        )

    def _matches(self, k: int, observation: ImageObservation) -> tuple[Ids, Ids]:
        """Return the features of a frame that match landmarks of a keyframe, and these landmarks."""
        keyframe = self._map.keyframes[k]
        mapped = np.flatnonzero(keyframe.landmark_of_feature >= 0)
        known = self._map.observation(k)
        pairs = match_by_word(
            known.bits[mapped],
            self._nodes(known.words[mapped]),
            observation.bits,
            self._nodes(observation.words),
            max_hamming=MAX_HAMMING,
            max_ratio=_MAX_RATIO,
        )
        hits = np.flatnonzero(pairs >= 0)
        return pairs[hits], keyframe.landmark_of_feature[mapped[hits]]

    def _nodes(self, words: Ids) -> Ids:
        return self._vocabulary.ancestors_of(words, level=_MATCHING_LEVEL)
