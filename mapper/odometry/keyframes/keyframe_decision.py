"""Keyframe decision of the local map: by the inliers of a frame's pose."""

from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.keyframes.pose_tracker import TrackedPose

_MIN_GAP = 4
"""Frames for which the last keyframe is young."""
_DEPTH_OVERLAP = 0.9
"""With less overlap of the surfaces a frame without landmarks becomes a keyframe: what is left may not show
every motion."""
_YOUNG_SHARE = 2.0 / 3.0
"""Share of ``keyframe_ratio`` that counts while the last keyframe is young and the inliers are not weak."""


class KeyframeDecision:
    """Decision whether a tracked frame becomes a keyframe (after Mur-Artal & Tardós 2017, §III-E)."""

    def __init__(self, config: KeyframeOdometryConfig) -> None:
        self._config = config
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
        # A motion that was not observed is uncertain in the factor too; other doubts have no measure.
        blind = tracked_pose.depth is not None and bool(tracked_pose.depth.unobservable)
        if len(tracked_pose.doubts) > blind:
            return False
        if blind and tracked_pose.depth is not None and tracked_pose.depth.observes_next:
            return True
        if self._frames >= config.max_keyframe_gap:
            return True
        if tracked_pose.depth is not None and inliers < config.min_inliers:
            textured = (
                tracked_pose.observation.has_depth.sum() >= config.weak_inliers and self._frames >= _MIN_GAP
            )
            return textured or tracked_pose.depth.overlap < _DEPTH_OVERLAP
        kept_ratio = inliers / self._most_inliers
        young = self._frames < _MIN_GAP and inliers >= config.weak_inliers
        share = _YOUNG_SHARE if young else 1.0
        # Landmarks at one edge of the image constrain the pose badly, however many they are.
        mapped_ratio = inliers / max(int(tracked_pose.observation.has_depth.sum()), 1)
        # Unless the map is searched, features without a landmark are not new.
        is_new = mapped_ratio < config.mapped_ratio and (config.local_keyframes > 0 or not young)
        return is_new or kept_ratio < share * config.keyframe_ratio
