"""Finding where a frame was taken: by predicted motion, by descriptors alone, and then in the local map."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.config.odometry import LocalMapConfig
from mapper.features.windowed import Words, match_everywhere, match_windows
from mapper.geometry import Array, Points, Transform, apply, exp, inverse, log
from mapper.odometry.local_map.gather import project_visible
from mapper.odometry.local_map.landmarks import Ids, LandmarkMap
from mapper.odometry.local_map.observation import Observation
from mapper.odometry.local_map.pose import ransac_pose, refine_pose

_LM_ROUNDS, _LM_ITERATIONS = 3, 8
_MAX_HAMMING = 64
_LAST_FRAME_RATIO, _LOCAL_MAP_RATIO, _FALLBACK_RATIO = 0.9, 0.8, 0.85
_SIMILARITY_FEATURES = 200
_BEST_LOOKALIKES = 5


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where a frame was found.

    Attributes:
        observation: The frame.
        T_camera_world: (4, 4).
        landmark_of_feature: (N,) int32 landmark that each feature shows, −1 for none; inliers only.
        reference: Keyframe that sees most of these landmarks.
        matches: Pairs that were proposed.
        residual_px: Root mean square image residual of the inliers.
        method: "map", "fallback" or "relocalised".
    """

    observation: Observation
    T_camera_world: Transform
    landmark_of_feature: Ids
    reference: int
    matches: int
    residual_px: float
    method: str

    @property
    def inliers(self) -> int:
        """How many features agree with the pose."""
        return int((self.landmark_of_feature >= 0).sum())


class Placer:
    """Searches a map for the pose of a frame; None is the answer "not found"."""

    def __init__(self, config: LocalMapConfig, landmark_map: LandmarkMap, *, scale_factor: float) -> None:
        self._config = config
        self._map = landmark_map
        self._scale_factor = scale_factor

    def by_motion(
        self, observation: Observation, last: Placement, before_last: Placement | None
    ) -> Placement | None:
        """Look for what the last frame saw where constant velocity predicts it."""
        T_camera_world = self._predicted(observation.stamp_ns, last, before_last)
        seen, points_world, landmark = self._seen_in(last)
        pixels = _project(T_camera_world, points_world, observation.intrinsics)
        for search_px in (self._config.search_px, 2.0 * self._config.search_px):
            feature = self._match_near(
                observation,
                pixels,
                last.observation.octave[seen],
                last.observation.words[seen],
                search_px=search_px,
                taken=np.zeros(len(observation), np.bool_),
                max_hamming=_MAX_HAMMING,
                max_ratio=_LAST_FRAME_RATIO,
            )
            hits = np.flatnonzero(feature >= 0)
            if len(hits) >= self._config.min_motion_matches:
                break
        else:
            return None
        T_camera_world, agree = _refined(T_camera_world, points_world[hits], observation, feature[hits])
        if agree.sum() < self._config.min_motion_matches // 2:
            return None
        landmark_of_feature = _nothing(observation)
        landmark_of_feature[feature[hits[agree]]] = landmark[hits[agree]]
        return self._in_local_map(
            observation, T_camera_world, landmark_of_feature, reference=last.reference, method="map"
        )

    def by_matching(
        self, observation: Observation, keyframes: Sequence[int], *, method: str
    ) -> Placement | None:
        """Match keyframes' descriptors without a prediction, and let three-point RANSAC find the pose."""
        for k in keyframes:
            keyframe = self._map.keyframes[k]
            seen = np.flatnonzero(keyframe.landmark_of_feature >= 0)
            pairs = match_everywhere(
                keyframe.observation.words[seen], observation.words, _MAX_HAMMING, _FALLBACK_RATIO
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
            T_camera_world, agree = _refined(T_camera_world, points_world, observation, features)
            landmark_of_feature = _nothing(observation)
            landmark_of_feature[features[agree]] = ids[agree]
            placement = self._in_local_map(
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
            pairs = match_everywhere(sample, words, _MAX_HAMMING, _FALLBACK_RATIO)
            scored.append((-int((pairs >= 0).sum()), k))
        return [k for _, k in sorted(scored)[:_BEST_LOOKALIKES]]

    def _predicted(self, stamp_ns: int, last: Placement, before_last: Placement | None) -> Transform:
        """Return T_camera_world under constant velocity, which dropped frames do not disturb."""
        if before_last is None:
            return last.T_camera_world
        t0, t1 = before_last.observation.stamp_ns, last.observation.stamp_ns
        steps = (stamp_ns - t1) / (t1 - t0)
        if steps > self._config.max_predicted_steps:
            return last.T_camera_world
        rotation_rad, translation_m = log(last.T_camera_world @ inverse(before_last.T_camera_world))
        T_camera_world: Transform = exp(steps * rotation_rad, steps * translation_m) @ last.T_camera_world
        return T_camera_world

    def _seen_in(self, placement: Placement) -> tuple[NDArray[np.intp], Points, Ids]:
        """Return the features whose place is known: indices, (M, 3) world points, landmark or −1.

        Features that are no landmarks help to find the motion: they stand where the depth image puts them.
        """
        observation, ids = placement.observation, placement.landmark_of_feature
        landmarks = self._map.landmarks
        known = (ids >= 0) & (landmarks["observers"][ids] > 0)
        near = observation.points_camera[:, 2] <= self._config.max_depth_m
        points_world = apply(inverse(placement.T_camera_world), observation.points_camera)
        points_world[known] = landmarks["position"][ids[known]]
        seen = np.flatnonzero(known | near)
        return seen, points_world[seen], np.where(known, ids, -1)[seen].astype(np.int32)

    def _in_local_map(
        self,
        observation: Observation,
        T_camera_world: Transform,
        landmark_of_feature: Ids,
        *,
        reference: int,
        method: str,
    ) -> Placement | None:
        """Search the landmarks of the most covisible keyframes and refine the pose with all that match."""
        config, landmarks = self._config, self._map.landmarks
        matched = landmark_of_feature[landmark_of_feature >= 0]
        counts = self._map.shared(matched)
        order = np.argsort(-counts, kind="stable")[: config.local_keyframes]
        local = [int(k) for k in order if counts[k] > 0] or [reference]
        nearby = self._map.seen_by_any(local, except_for=matched)
        rows, pixels, octave = project_visible(
            nearby,
            landmarks["position"],
            landmarks["direction"],
            landmarks["reach_m"],
            T_camera_world,
            observation.intrinsics,
            np.array(observation.size_px),
            math.log(self._scale_factor),
            config.detector.levels,
        )
        visible = nearby[rows]
        feature = self._match_near(
            observation,
            pixels,
            octave,
            landmarks["words"][visible],
            search_px=config.local_search_px,
            taken=landmark_of_feature >= 0,
            max_hamming=_MAX_HAMMING,
            max_ratio=_LOCAL_MAP_RATIO,
        )
        hits = np.flatnonzero(feature >= 0)
        landmark_of_feature = landmark_of_feature.copy()
        landmark_of_feature[feature[hits]] = visible[hits]
        features = np.flatnonzero(landmark_of_feature >= 0)
        ids = landmark_of_feature[features]
        if len(features) < config.min_inliers:
            return None
        T_camera_world, agree = _refined(T_camera_world, landmarks["position"][ids], observation, features)
        if agree.sum() < config.min_inliers:
            return None
        landmark_of_feature[features[~agree]] = -1
        landmarks["visible"][visible] += 1
        landmarks["visible"][matched] += 1
        landmarks["found"][ids[agree]] += 1
        seen_at = _project(T_camera_world, landmarks["position"][ids[agree]], observation.intrinsics)
        miss_px = seen_at - observation.pixels[features[agree]]
        return Placement(
            observation,
            T_camera_world,
            landmark_of_feature,
            local[0],
            len(features),
            math.sqrt(float((miss_px**2).sum(axis=1).mean())),
            method,
        )

    def _match_near(
        self,
        observation: Observation,
        pixels: Array,
        octave: NDArray[np.int32],
        words: Words,
        *,
        search_px: float,
        taken: NDArray[np.bool_],
        max_hamming: int,
        max_ratio: float,
    ) -> Ids:
        """Return, per predicted pixel, the matching feature or −1; coarser octaves search wider."""
        grid = observation.grid
        matched: Ids = match_windows(
            pixels,
            octave,
            search_px * self._scale_factor ** octave.astype(np.float64),
            words,
            observation.pixels,
            observation.octave,
            observation.words,
            taken,
            grid.start,
            grid.columns,
            grid.rows,
            max_hamming,
            max_ratio,
        )
        return matched


def _nothing(observation: Observation) -> Ids:
    return np.full(len(observation), -1, np.int32)


def _project(T_camera_world: Transform, points_world: Points, intrinsics: Array) -> Array:
    """Return the pixels of world points; those behind the camera land far outside the image."""
    points_camera = apply(T_camera_world, points_world)
    z = np.where(points_camera[:, 2] > 0.05, points_camera[:, 2], np.nan)
    pixels = points_camera[:, :2] / z[:, None] * intrinsics[:2] + intrinsics[2:4]
    return np.nan_to_num(pixels, nan=-1e6)


def _refined(
    T_camera_world: Transform,
    points_world: Points,
    observation: Observation,
    features: NDArray[np.integer],
) -> tuple[Transform, NDArray[np.bool_]]:
    """Return the refined T_camera_world and which pairs agree with it."""
    T_refined, inlier, _ = refine_pose(
        T_camera_world,
        points_world,
        observation.measured[features],
        observation.weights[features],
        observation.intrinsics,
        _LM_ROUNDS,
        _LM_ITERATIONS,
    )
    return T_refined, inlier
