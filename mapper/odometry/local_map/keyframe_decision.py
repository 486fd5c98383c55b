"""Keyframe decision of the local map: by the inliers of a frame's pose."""

from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.local_map.landmarks.landmark_map import LandmarkMap
from mapper.odometry.local_map.pose.assessment import UNOBSERVED_MOTION
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose

_MIN_GAP = 4
"""Frames for which the last keyframe is recent."""
_RECENT_NS = 150_000_000
"""Time for which it is recent at most: four frames at 30 Hz. At 5 Hz four frames may show a whole turn, and
the landmarks of one keyframe place the last of them badly."""
_ENOUGH_NEW = 4
"""Features with depth, relative to ``min_inliers``, by which a keyframe may end tracking by depth alone."""
_DEPTH_OVERLAP = 0.9
"""With less overlap of the surfaces a frame without landmarks becomes a keyframe: what is left may not show
every motion."""
_RECENT_SHARE = 2.0 / 3.0
"""Share of ``keyframe_ratio`` that counts while the last keyframe is recent and the inliers are not weak."""


class KeyframeDecision:
    """Decision whether a tracked frame becomes a keyframe (after Mur-Artal & Tardós 2017, §III-E)."""

    def __init__(self, config: KeyframeOdometryConfig, landmark_map: LandmarkMap) -> None:
        self._config = config
        self._map = landmark_map
        self.restart()

    def restart(self) -> None:
        """Begin anew after a keyframe."""
        self._most_inliers = 0
        self._frames = 0

    def is_due(self, tracked_pose: TrackedPose) -> bool:
        """Return whether the next tracked frame becomes a keyframe."""
        config, inliers = self._config, tracked_pose.inliers
        self._frames += 1
        self._most_inliers = max(self._most_inliers, inliers)
        if any(doubt.kind != UNOBSERVED_MOTION for doubt in tracked_pose.doubts):
            return False
        unobserved = tracked_pose.depth is not None and bool(tracked_pose.depth.unobservable)
        if unobserved and tracked_pose.depth is not None and tracked_pose.depth.observes_next:
            return True
        if self._frames >= config.max_keyframe_gap:
            return True
        if tracked_pose.depth is not None and inliers < config.min_inliers:
            textured = (
                tracked_pose.observation.has_depth.sum() >= _ENOUGH_NEW * config.min_inliers
                and self._frames >= _MIN_GAP
            )
            return textured or tracked_pose.depth.overlap < _DEPTH_OVERLAP
        kept_ratio = inliers / self._most_inliers
        age_ns = tracked_pose.stamp_ns - self._map.keyframes[-1].stamp_ns
        is_recent = self._frames < _MIN_GAP and age_ns < _RECENT_NS and inliers >= config.weak_inliers
        share = _RECENT_SHARE if is_recent else 1.0
        # Landmarks at one edge of the image constrain the pose badly, however many they are.
        ids = tracked_pose.landmark_of_feature
        triangulated = (ids >= 0) & (self._map.landmarks["ray_sigma_m"][ids] > 0.0)
        mapped_ratio = inliers / max(int((tracked_pose.observation.has_depth | triangulated).sum()), 1)
        # Unless the map is searched, features without a landmark are not new.
        is_new = mapped_ratio < config.mapped_ratio and (config.local_keyframes > 0 or not is_recent)
        return is_new or kept_ratio < share * config.keyframe_ratio
