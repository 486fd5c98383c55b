"""Pose tracker by constant velocity: the last frame's points are searched near their predicted pixels."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Points, apply, inverse
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.local_map.image_observation import ImageObservation
from mapper.odometry.local_map.landmarks import Ids, LandmarkMap
from mapper.odometry.local_map.local_search import LocalSearch
from mapper.odometry.local_map.pose_tracker import TrackedPose, predicted, project, refined, unmatched
from mapper.odometry.local_map.relocalizer import Relocalizer

_MAX_RATIO = 0.9


class MotionPoseTracker:
    """Pose tracker by predicted motion, and by matching without a prediction where that finds little."""

    def __init__(self, config: LocalMapConfig, landmark_map: LandmarkMap, relocalizer: Relocalizer) -> None:
        self._config = config
        self._map = landmark_map
        self._search = LocalSearch(config, landmark_map)
        self._relocalizer = relocalizer

    def track(
        self, observation: ImageObservation, last: TrackedPose, before_last: TrackedPose | None
    ) -> TrackedPose | None:
        """Try the predicted motion, then the latest keyframes."""
        by_motion = self._by_motion(observation, last, before_last)
        if by_motion is not None and by_motion.inliers >= self._config.weak_inliers:
            return by_motion
        # A pose with few inliers may be wrong, so a pose that does not depend on the prediction competes.
        known, points_world, landmarks = self._known_points(last)
        by_last = self._relocalizer.match_points(
            observation,
            last.observation.bits[known],
            points_world,
            landmarks,
            reference=last.reference,
            method="matched",
        )
        found = [tracked_pose for tracked_pose in (by_motion, by_last) if tracked_pose is not None]
        best = max(found, key=lambda tracked_pose: tracked_pose.inliers, default=None)
        if best is not None and best.inliers >= self._config.weak_inliers:
            return best
        by_keyframe = self._relocalizer.best_among(
            self._map.latest(last.reference), observation, method="fallback", exhaustive=True
        )
        found = [tracked_pose for tracked_pose in (best, by_keyframe) if tracked_pose is not None]
        return max(found, key=lambda tracked_pose: tracked_pose.inliers, default=None)

    def _by_motion(
        self, observation: ImageObservation, last: TrackedPose, before_last: TrackedPose | None
    ) -> TrackedPose | None:
        """Search the last frame's points near the pixels that constant velocity predicts."""
        T_predicted = predicted(observation.stamp_ns, last, before_last)
        T_camera_world = last.T_camera_world if T_predicted is None else T_predicted
        known, points_world, landmark = self._known_points(last)
        pixels = project(T_camera_world, points_world, observation.intrinsics)
        depth_m = apply(T_camera_world, points_world)[:, 2]
        for search_px in (self._config.search_px, 2.0 * self._config.search_px):
            feature = self._search.match_near(
                observation,
                pixels,
                depth_m,
                last.observation.octave[known],
                last.observation.bits[known],
                search_px=search_px,
                taken=np.zeros(len(observation), np.bool_),
                max_ratio=_MAX_RATIO,
            )
            hits = np.flatnonzero(feature >= 0)
            if len(hits) >= self._config.min_matches:
                break
        else:
            return None
        T_camera_world, agree = refined(T_camera_world, points_world[hits], observation, feature[hits])
        if agree.sum() < self._config.min_matches // 2:
            return None
        landmark_of_feature = unmatched(observation)
        landmark_of_feature[feature[hits[agree]]] = landmark[hits[agree]]
        return self._search.refine(
            observation,
            T_camera_world,
            landmark_of_feature,
            reference=last.reference,
            agreement=float(agree.mean()),
            method="map",
        )

    def _known_points(self, tracked_pose: TrackedPose) -> tuple[NDArray[np.intp], Points, Ids]:
        """Return the features with a known 3D point: indices, (M, 3) world points, landmark or −1.

        Features that are no landmarks help to find the motion: their points are from the depth image.
        """
        observation, ids = tracked_pose.observation, tracked_pose.landmark_of_feature
        landmarks = self._map.landmarks
        is_landmark = (ids >= 0) & (landmarks["observers"][ids] > 0)
        points_world = apply(inverse(tracked_pose.T_camera_world), observation.points_camera)
        points_world[is_landmark] = landmarks["position"][ids[is_landmark]]
        known = np.flatnonzero(is_landmark | observation.has_depth)
        return known, points_world[known], np.where(is_landmark, ids, -1)[known].astype(np.int32)
