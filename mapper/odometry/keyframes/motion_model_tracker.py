"""Pose tracker by predicted motion: the last frame's points are searched near their predicted pixels."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.doubts import Doubt
from mapper.core.geometry import Points, Transform, apply, inverse
from mapper.odometry.camera.image_observation import ImageObservation
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.keyframes.depth_comparison import EarlierDepth
from mapper.odometry.keyframes.landmarks import Ids, LandmarkMap
from mapper.odometry.keyframes.local_search import LocalSearch
from mapper.odometry.keyframes.motion_segmentation import agreeing, camera_motion
from mapper.odometry.keyframes.pose_tracker import WEAK_INLIERS, TrackedPose, project, unmatched
from mapper.odometry.keyframes.relocalizer import Relocalizer

_MAX_RATIO = 0.9
_LEAST_STILL_RATIO = 0.2
"""When fewer matches stand still, it is the prediction that is wrong."""
_RIVAL_RATIO = 0.5
"""A pose of fewer inliers, relative to the better one, does not cast doubt on it."""
_SAME_RATIO = 0.5
"""Of two poses that are the same, each has more of the other's inliers."""


class MotionPoseTracker:
    """Pose tracker by predicted motion, and by matching without a prediction where that finds little."""

    def __init__(self, config: LocalMapConfig, landmark_map: LandmarkMap, relocalizer: Relocalizer) -> None:
        self._config = config
        self._map = landmark_map
        self._search = LocalSearch(config, landmark_map)
        self._relocalizer = relocalizer
        self._earlier_depth = EarlierDepth(landmark_map, config.depth_noise)

    def track(
        self, observation: ImageObservation, last: TrackedPose, T_predicted: Transform | None
    ) -> TrackedPose | None:
        """Try the predicted motion, then the latest keyframes."""
        by_motion = self._by_motion(observation, last, T_predicted)
        if by_motion is not None and by_motion.inliers >= WEAK_INLIERS:
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
        best = self._better(by_motion, by_last)
        if best is not None and best.inliers >= WEAK_INLIERS:
            return best
        by_keyframe = self._relocalizer.best_among(
            self._map.latest(last.reference), observation, method="fallback", exhaustive=True
        )
        return self._better(best, by_keyframe)

    def _better(self, a: TrackedPose | None, b: TrackedPose | None) -> TrackedPose | None:
        """Return the pose of more inliers, which is doubtful if those of the other one contradict it."""
        if a is None or b is None:
            return a or b
        best, other = (a, b) if a.inliers >= b.inliers else (b, a)
        features = np.flatnonzero(other.landmark_of_feature >= 0)
        positions_world = self._map.landmarks["position"][other.landmark_of_feature[features]]
        agree = agreeing(
            best.T_camera_world, positions_world, best.observation, features, best.observation.weights
        )
        if len(features) < _RIVAL_RATIO * best.inliers or agree.mean() >= _SAME_RATIO:
            return best
        doubt = Doubt("disagreement", f"{len(features)} features show another pose than these {best.inliers}")
        return replace(best, doubts=(*best.doubts, doubt))

    def _by_motion(
        self, observation: ImageObservation, last: TrackedPose, T_predicted: Transform | None
    ) -> TrackedPose | None:
        """Search the last frame's points near their predicted pixels."""
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
        moved = np.zeros(len(observation), np.bool_)
        if T_predicted is not None:  # seen from a pose that is merely the last one, all seems to have moved
            moved = self._earlier_depth.moved(observation, T_camera_world, last.reference)
        still = ~moved[feature[hits]]
        if still.sum() >= max(self._config.min_matches, _LEAST_STILL_RATIO * len(hits)):
            hits = hits[still]
        motion = camera_motion(
            T_camera_world,
            points_world[hits],
            observation,
            feature[hits],
            np.where(landmark[hits] >= 0, self._map.landmarks["observers"][landmark[hits]], 0),
            observation.weights_among(moved),
        )
        agree = motion.agree
        if agree.sum() < self._config.min_matches // 2:
            return None
        landmark_of_feature = unmatched(observation)
        landmark_of_feature[feature[hits[agree]]] = landmark[hits[agree]]
        found = self._search.refine(
            observation,
            motion.T_camera_world,
            landmark_of_feature,
            reference=last.reference,
            method="map",
        )
        if found is None:
            return None
        return replace(
            found,
            doubts=motion.doubts,
            moving=np.union1d(feature[hits[motion.moving]], found.moving).astype(np.int32),
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
        still = np.ones(len(observation), np.bool_)
        still[tracked_pose.moving] = False
        known = np.flatnonzero((is_landmark | observation.has_depth) & still)
        return known, points_world[known], np.where(is_landmark, ids, -1)[known].astype(np.int32)
