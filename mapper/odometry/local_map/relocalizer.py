"""Placing a frame by descriptors alone: nothing is predicted, so it works after a jump and after a loss."""

from collections.abc import Iterable

import numpy as np

from mapper.core.geometry import Array
from mapper.odometry.config import KeyframeConfig
from mapper.odometry.local_map.landmarks import Ids, LandmarkMap
from mapper.odometry.local_map.local_search import LocalSearch
from mapper.odometry.local_map.observation import Observation
from mapper.odometry.local_map.pose_tracker import MAX_HAMMING, TrackedPose, refined, unmatched
from mapper.places.guided import match_by_word
from mapper.places.index import PlaceIndex
from mapper.places.vocabulary import Vocabulary
from mapper.registration.p3p import ransac_p3p

_MAX_RATIO = 0.85
_MATCHING_LEVEL = 2
"""Only descriptors under one node this many steps below the vocabulary's root are compared (Zhao et al. 2020,
§1.1): the toolkit's own vocabulary has 169 such nodes, so that a frame has a few features under each."""


class Relocalizer:
    """Finds a frame among the keyframes; None is the answer "not found"."""

    def __init__(self, config: KeyframeConfig, landmark_map: LandmarkMap, vocabulary: Vocabulary) -> None:
        self._config = config
        self._map = landmark_map
        self._search = LocalSearch(config, landmark_map)
        self._vocabulary = vocabulary
        self._index = PlaceIndex(vocabulary)

    def add(self, keyframe: int) -> None:
        """Learn what a keyframe looks like."""
        words = self._map.keyframes[keyframe].observation.words
        self._index.add(keyframe, self._vocabulary.vector(words))

    def among(self, keyframes: Iterable[int], observation: Observation, *, method: str) -> TrackedPose | None:
        """Return the first placement that many landmarks agree with; failing that, the best of the weak ones.

        A weak one may be wrong: things that repeat have led to a hundred inliers metres away.
        """
        best: TrackedPose | None = None
        for k in keyframes:
            tracked_pose = self._beside(k, observation, method=method)
            if tracked_pose is not None and (best is None or tracked_pose.inliers > best.inliers):
                best = tracked_pose
                if best.inliers >= self._config.weak_inliers:
                    break
        return best

    def candidates(self, observation: Observation, here_world: Array) -> list[int]:
        """Return keyframes that a frame may show: those most like it, best first, then the nearest.

        Args:
            observation: The frame.
            here_world: (3,) metres: where the camera was last.
        """
        budget = self._config.relocalisation_keyframes
        seen = self._vocabulary.vector(observation.words)
        alike = [k for k, _ in self._index.query(seen, min_similarity=0.0, limit=budget)]
        T_camera_world = np.array([keyframe.T_camera_world for keyframe in self._map.keyframes])
        here_camera = T_camera_world[:, :3, :3] @ here_world + T_camera_world[:, :3, 3]
        nearest = np.argsort(np.linalg.norm(here_camera, axis=1), kind="stable")[:budget]
        return list(dict.fromkeys([*alike, *map(int, nearest)]))

    def _beside(self, k: int, observation: Observation, *, method: str) -> TrackedPose | None:
        """Match one keyframe and place the frame by P3P.

        Only descriptors under the same node of the vocabulary are compared (B2); Levenberg–Marquardt then
        refines the pose over the inliers of RANSAC (B3).
        """
        features, ids = self._matches(k, observation)
        if len(features) < self._config.min_matches:
            return None
        points_world = self._map.landmarks["position"][ids]
        found = ransac_p3p(
            points_world,
            observation.pixels[features],
            observation.intrinsics,
            tolerance_px=self._config.ransac_tolerance_px,
            iterations=self._config.ransac_iterations,
            seed=self._config.ransac_seed,
        )
        if found is None:
            return None
        T_camera_world, agreeing = found
        fewest = max(self._config.min_agreement_ratio * len(features), self._config.min_matches // 2)
        if len(agreeing) < fewest:
            return None
        features, ids = features[agreeing], ids[agreeing]
        T_camera_world, agree = refined(T_camera_world, points_world[agreeing], observation, features)
        landmark_of_feature = unmatched(observation)
        landmark_of_feature[features[agree]] = ids[agree]
        return self._search.placed(
            observation, T_camera_world, landmark_of_feature, reference=k, method=method
        )

    def _matches(self, k: int, observation: Observation) -> tuple[Ids, Ids]:
        """Return the features of a frame that match a keyframe's, and the landmarks that they then show."""
        keyframe = self._map.keyframes[k]
        seen = np.flatnonzero(keyframe.landmark_of_feature >= 0)
        pairs = match_by_word(
            keyframe.observation.bits[seen],
            self._nodes(keyframe.observation.words[seen]),
            observation.bits,
            self._nodes(observation.words),
            max_hamming=MAX_HAMMING,
            max_ratio=_MAX_RATIO,
        )
        hits = np.flatnonzero(pairs >= 0)
        return pairs[hits], keyframe.landmark_of_feature[seen[hits]]

    def _nodes(self, words: Ids) -> Ids:
        return self._vocabulary.ancestors_of(words, level=_MATCHING_LEVEL)
