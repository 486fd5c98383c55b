"""Decision which tracked frames become keyframes."""

from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.keyframes.frame_doubts import Assessment
from mapper.odometry.keyframes.pose_tracker import WEAK_INLIERS, TrackedPose

_MIN_GAP = 4
"""Frames for which the last keyframe is young."""
_YOUNG_SHARE = 2.0 / 3.0
"""Share of ``keyframe_ratio`` that counts while the last keyframe is young and the inliers are not weak."""
MAPPED_RATIO = 0.5
"""With fewer inliers, as a share of the features with depth, much of the view is new."""
_DEPTH_OVERLAP = 0.9
"""With less overlap of the surfaces a frame without landmarks becomes a keyframe: what is left may not show
every motion."""


class KeyframeDecision:
    """Decision whether a tracked frame becomes a keyframe (after Mur-Artal & Tardós 2017, §III-E)."""

    def __init__(self, config: KeyframeOdometryConfig) -> None:
        self._config = config
        self._most_inliers = 0
        self._frames = 0  # since the last keyframe

    def restart(self) -> None:
        """Begin anew after a keyframe."""
        self._most_inliers = 0
        self._frames = 0

    def is_due(self, tracked_pose: TrackedPose, assessed: Assessment) -> bool:
        """Return whether the next tracked frame becomes a keyframe.

        A doubtful frame with enough inliers does not: tracking goes on without it. With fewer, its landmarks
        may be all that the next one sees; its factor is as uncertain as the doubts say.
        """
        config, inliers = self._config, tracked_pose.inliers
        self._frames += 1
        self._most_inliers = max(self._most_inliers, inliers)
        if assessed.doubts and inliers >= WEAK_INLIERS:
            return False
        depth = tracked_pose.depth
        if depth is not None and depth.unobservable and depth.observes_next:
            return True
        if self._frames >= config.max_keyframe_gap:
            return True
        if depth is not None and inliers < config.min_inliers:
            is_textured = (
                tracked_pose.observation.has_depth.sum() >= WEAK_INLIERS and self._frames >= _MIN_GAP
            )
            return is_textured or depth.overlap < _DEPTH_OVERLAP
        kept_ratio = inliers / self._most_inliers
        is_young = self._frames < _MIN_GAP and inliers >= WEAK_INLIERS
        share = _YOUNG_SHARE if is_young else 1.0
        # Landmarks at one edge of the image constrain the pose badly, however many they are.
        mapped_ratio = inliers / max(int(tracked_pose.observation.has_depth.sum()), 1)
        # Unless the map is searched, features without a landmark are not new.
        is_new = mapped_ratio < MAPPED_RATIO and (config.local_keyframes > 0 or not is_young)
        return is_new or kept_ratio < share * config.keyframe_ratio
