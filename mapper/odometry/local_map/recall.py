"""Placing a frame by descriptors alone: nothing is predicted, so it works after a jump and after a loss."""

from collections.abc import Sequence

import numpy as np

from mapper.config.odometry import KeyframeConfig
from mapper.features.windowed import match_everywhere
from mapper.geometry import Array, inverse
from mapper.odometry.local_map.landmarks import LandmarkMap
from mapper.odometry.local_map.local_search import LocalSearch
from mapper.odometry.local_map.observation import Observation
from mapper.odometry.local_map.placing import MAX_HAMMING, Placement, refined, unmatched
from mapper.odometry.local_map.pose import ransac_pose

_MAX_RATIO = 0.85
_SIMILARITY_FEATURES = 200
_BEST_LOOKALIKES = 5


class Recall:
    """Finds a frame among the keyframes; None is the answer "not found"."""

    def __init__(self, config: KeyframeConfig, landmark_map: LandmarkMap, search: LocalSearch) -> None:
        self._config = config
        self._map = landmark_map
        self._search = search

    def among(self, keyframes: Sequence[int], observation: Observation, *, method: str) -> Placement | None:
        """Return the first placement that matching a keyframe and three-point RANSAC lead to."""
        for k in keyframes:
            keyframe = self._map.keyframes[k]
            seen = np.flatnonzero(keyframe.landmark_of_feature >= 0)
            pairs = match_everywhere(
                keyframe.observation.words[seen], observation.words, MAX_HAMMING, _MAX_RATIO
            )
            hits = np.flatnonzero(pairs >= 0)
            hits = hits[observation.has_depth[pairs[hits]]]
            if len(hits) < self._config.min_motion_matches:
                continue
            ids, features = keyframe.landmark_of_feature[seen[hits]], pairs[hits]
            points_world = self._map.landmarks["position"][ids]
            rng = np.random.default_rng([observation.stamp_ns % (1 << 32), k])
            T_camera_world, agreeing = ransac_pose(
                points_world,
                observation.measured[features],
                observation.points_camera[features],
                observation.weights[features],
                observation.intrinsics,
                rng.integers(len(hits), size=(self._config.ransac_iterations, 3)),
            )
            if agreeing < self._config.min_motion_matches // 2:
                continue
            T_camera_world, agree = refined(T_camera_world, points_world, observation, features)
            landmark_of_feature = unmatched(observation)
            landmark_of_feature[features[agree]] = ids[agree]
            placement = self._search.placed(
                observation, T_camera_world, landmark_of_feature, reference=k, method=method
            )
            if placement is not None:
                return placement
        return None

    def lookalikes(self, observation: Observation, here_world: Array, *, turn: int) -> list[int]:
        """Return the keyframes most like a frame, best first.

        Args:
            observation: The frame.
            here_world: (3,) metres; the keyframes nearest to it are always compared.
            turn: Which share of the remaining keyframes is compared too; count it up while lost.
        """
        keyframes, budget = self._map.keyframes, self._config.relocalisation_keyframes
        centres = np.array([inverse(k.T_camera_world)[:3, 3] for k in keyframes])
        ranked = np.argsort(np.linalg.norm(centres - here_world, axis=1), kind="stable")
        near, rest = ranked[:budget], np.roll(ranked[budget:], -turn * budget)[:budget]
        finest = np.argsort(observation.octave, kind="stable")
        sample = observation.words[finest[:: max(len(finest) // _SIMILARITY_FEATURES, 1)]]
        scored = []
        for k in map(int, (*near, *rest)):
            words = keyframes[k].observation.words[keyframes[k].landmark_of_feature >= 0]
            pairs = match_everywhere(sample, words, MAX_HAMMING, _MAX_RATIO)
            scored.append((-int((pairs >= 0).sum()), k))
        return [k for _, k in sorted(scored)[:_BEST_LOOKALIKES]]
