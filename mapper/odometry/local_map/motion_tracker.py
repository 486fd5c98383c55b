"""Pose tracker by constant velocity: the last frame's points are searched near their predicted pixels."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.doubts import Doubt
from mapper.core.geometry import Points, Transform, apply, inverse
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.local_map.depth.earlier_depth import EarlierDepth
from mapper.odometry.local_map.landmarks.landmark_map import Ids, LandmarkMap
from mapper.odometry.local_map.observation.image_observation import ImageObservation
from mapper.odometry.local_map.pose.camera_motion import CameraMotion, agreeing, camera_motion
from mapper.odometry.local_map.pose.local_search import LocalSearch, PredictedFeatures
from mapper.odometry.local_map.pose.moving_feature_tracker import MovingFeatureTracker
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose, project, unmatched
from mapper.odometry.local_map.pose.triangulation import weights_with_landmarks
from mapper.odometry.local_map.recovery.relocalizer import Relocalizer

_MAX_RATIO = 0.9
_LEAST_STILL_RATIO = 0.2
"""When fewer matches are at rest, the prediction is wrong."""
_RIVAL_RATIO = 0.5
"""A pose of fewer inliers, relative to the better one, does not make it doubtful."""
_SAME_RATIO = 0.5
"""Of two poses that are the same, each has more of the other's inliers."""


class MotionPoseTracker:
    """Pose tracker by predicted motion, and by matching without a prediction where that finds little."""

    def __init__(self, config: LocalMapConfig, landmark_map: LandmarkMap, relocalizer: Relocalizer) -> None:
        self._config = config
        self._map = landmark_map
        self._search = LocalSearch(config, landmark_map)
        self._moving = MovingFeatureTracker(config, self._search)
        self._relocalizer = relocalizer
        self._earlier_depth = EarlierDepth(landmark_map, config.depth_noise)

    def track(
        self, observation: ImageObservation, last: TrackedPose, T_predicted: Transform | None
    ) -> TrackedPose | None:
        """Try the predicted motion, then the latest keyframes."""
        by_motion = self._by_motion(observation, last, T_predicted)
        best = self._best(by_motion, observation, last)
        if best is None or best is by_motion:
            return best
        is_moving = self._moving.moving(
            best.T_camera_world,
            observation,
            last,
            observation.mask_of(best.moving),
            best.landmark_of_feature >= 0,
        )
        return best if is_moving is None else replace(best, moving=np.flatnonzero(is_moving).astype(np.int32))

    def _best(
        self, by_motion: TrackedPose | None, observation: ImageObservation, last: TrackedPose
    ) -> TrackedPose | None:
        """Return the pose of most inliers, which few inliers are compared with."""
        if by_motion is not None and by_motion.inliers >= self._config.weak_inliers:
            return by_motion
        # A pose with few inliers may be wrong: it is compared with one that needs no prediction.
        known, points_world, landmarks = self._known_points(last)
        by_last = self._relocalizer.match_points(
            observation,
            last.observation.bits[known],
            points_world,
            landmarks,
            reference=last.reference,
            method="matched",
        )
        best = self._better(by_motion, by_last)
        if best is not None and best.inliers >= self._config.weak_inliers:
            return best
        by_keyframe = self._relocalizer.best_among(
            self._map.latest(last.reference), observation, method="fallback", exhaustive=True
        )
        return self._better(best, by_keyframe)

    def _better(self, a: TrackedPose | None, b: TrackedPose | None) -> TrackedPose | None:
        """Return the pose of more inliers, which is doubtful if those of the other one contradict it.

        While something moves in view, the other one needs twice as many as ``a``, which is nearer to what is
        predicted.
        """
        if a is None or b is None:
            return a or b
        least = 1.0 if a.few_move else _RIVAL_RATIO
        best, other = (a, b) if a.inliers >= least * b.inliers else (b, a)
        features = np.flatnonzero(other.landmark_of_feature >= 0)
        positions_world = self._map.landmarks["position"][other.landmark_of_feature[features]]
        agree = agreeing(
            best.T_camera_world, positions_world, best.observation, features, best.observation.weights
        )
        if len(features) < _RIVAL_RATIO * best.inliers or agree.mean() >= _SAME_RATIO:
            return best
        text = f"{len(features)} features show another pose than these {best.inliers}"
        return replace(best, doubts=(*best.doubts, Doubt("another pose", text)))

    def _by_motion(
        self, observation: ImageObservation, last: TrackedPose, T_predicted: Transform | None
    ) -> TrackedPose | None:
        """Search the last frame's points near the pixels where the prediction has them."""
        T_camera_world = last.T_camera_world if T_predicted is None else T_predicted
        known, points_world, landmark = self._known_points(last)
        feature = self._matched(observation, last, known, points_world, T_camera_world)
        hits = np.flatnonzero(feature >= 0)
        if len(hits) < self._config.min_matches:
            return None
        moved = self._earlier_depth.moved(observation, T_camera_world, last.reference)
        still = ~moved[feature[hits]]
        if still.sum() >= max(self._config.min_matches, _LEAST_STILL_RATIO * len(hits)):
            hits = hits[still]
        features, ids = feature[hits], landmark[hits]
        motion = camera_motion(
            T_camera_world,
            points_world[hits],
            observation,
            features,
            np.where(ids >= 0, self._map.landmarks["observers"][ids], 0),
            weights_with_landmarks(
                self._map, T_camera_world, observation, features, ids, observation.weights_among(moved)
            ),
            self._map.residual_variance,
        )
        if motion.agree.sum() < self._config.min_matches // 2:
            return None
        return self._refined(motion, observation, last, features, ids, moved)

    def _refined(
        self,
        motion: CameraMotion,
        observation: ImageObservation,
        last: TrackedPose,
        features: Ids,
        ids: Ids,
        moved: NDArray[np.bool_],
    ) -> TrackedPose | None:
        """Refine the pose of a motion by the landmarks around it, and return it with what moves by itself."""
        agree = motion.agree
        contradicting = features[motion.moving] if not motion.doubts else features[:0]
        is_moving = self._moving.moving(
            motion.T_camera_world,
            observation,
            last,
            moved | observation.mask_of(contradicting),
            observation.mask_of(features[agree]),
            observation.mask_of(features[~agree]),
        )
        landmark_of_feature = unmatched(observation)
        landmark_of_feature[features[agree]] = ids[agree]
        found = self._search.refine(
            observation,
            motion.T_camera_world,
            landmark_of_feature,
            reference=last.reference,
            agreement=float(agree.mean()),
            method="map",
            is_moving=is_moving,
        )
        if found is None:
            return None
        moving = found.moving
        if is_moving is None:
            moving = np.union1d(features[motion.moving], moving).astype(np.int32)
        return replace(found, doubts=motion.doubts, moving=moving)

    def _matched(
        self,
        observation: ImageObservation,
        last: TrackedPose,
        known: NDArray[np.intp],
        points_world: Points,
        T_camera_world: Transform,
    ) -> Ids:
        """Return the feature of each of the last frame's points, −1 for none; with too few, twice as far."""
        predicted = PredictedFeatures(
            project(T_camera_world, points_world, observation.intrinsics),
            apply(T_camera_world, points_world)[:, 2],
            last.observation.octave[known],
            last.observation.bits[known],
        )
        free = np.zeros(len(observation), np.bool_)
        for search_px in (self._config.search_px, 2.0 * self._config.search_px):
            feature = self._search.match_near(
                observation, predicted, search_px=search_px, taken=free, max_ratio=_MAX_RATIO
            )
            if (feature >= 0).sum() >= self._config.min_matches:
                break
        return feature

    def _known_points(self, tracked_pose: TrackedPose) -> tuple[NDArray[np.intp], Points, Ids]:
        """Return the features with a known 3D point: indices, (M, 3) world points, landmark or −1.

        Features that are no landmarks help to find the motion: their points are from the depth image.
        """
        observation, ids = tracked_pose.observation, tracked_pose.landmark_of_feature
        landmarks = self._map.landmarks
        is_landmark = (ids >= 0) & (landmarks["observers"][ids] > 0)
        points_world = apply(inverse(tracked_pose.T_camera_world), observation.points_camera)
        points_world[is_landmark] = landmarks["position"][ids[is_landmark]]
        still = np.ones(len(observation), np.bool_)
        still[tracked_pose.moving] = False
        known = np.flatnonzero((is_landmark | observation.has_depth) & still)
        return known, points_world[known], np.where(is_landmark, ids, -1)[known].astype(np.int32)
