"""Check of poses found after a gap: another place that looks alike may have been recognised."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import RgbdFrame
from mapper.core.geometry import Array, inverse
from mapper.core.timebase import NS_PER_S
from mapper.odometry.base import MotionCheck, fastest_m_s, is_gap
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.local_map.landmarks.landmark_map import LandmarkMap
from mapper.odometry.local_map.pose.local_search import LocalSearch
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose
from mapper.registration.image_agreement import NOTHING_COMPARED, ImageAgreement, image_agreement

_COLUMNS, _ROWS = 8, 6
"""Parts of an image in which landmarks are looked for."""
_MIN_LANDMARKS = 3
"""Landmarks in view that a part must have for it to count."""
_MIN_SPREAD = 0.45
"""Least number of parts with inliers, relative to what as many of the landmarks in view give if drawn at
random. Posters and patches alike on two walls gave 0.17 to 0.43 by the wrong one; right poses after 1.5 to
6 s give 0.51 and more, one of blurred images 0.47; those of fr1_xyz 0.8 and more."""
_KEYFRAMES = 3
"""Keyframes whose images are compared with a frame's: those that share most landmarks with it."""
_MIN_SAME, _MIN_LOCAL_CORRELATION = 0.3, 0.35
"""Least share of the compared surfaces at the same depth, and least correlation of what is on them. By wrong
poses whose few inliers were spread, 0.02 and 0.08 were at the same depth, or the correlation was 0.04 and
0.19; by right ones at least 0.51 were, and it was 0.5 and more."""


class GapCheck:
    """Check of poses after a gap: by the motion that they imply, and by what should be in view."""

    def __init__(
        self, config: KeyframeOdometryConfig, landmark_map: LandmarkMap, motion_check: MotionCheck | None
    ) -> None:
        self._map = landmark_map
        self._search = LocalSearch(config, landmark_map)
        self._motion_check = motion_check

    def is_needed(self, tracked_pose: TrackedPose, last: TrackedPose) -> bool:
        """Return whether a pose is found after a gap, or in another sub-map than the last one."""
        keyframes = self._map.keyframes
        one_map = keyframes[tracked_pose.reference].origin == keyframes[last.reference].origin
        return not one_map or is_gap(last.stamp_ns, tracked_pose.stamp_ns)

    def is_out_of_reach(self, tracked_pose: TrackedPose, last: TrackedPose, usual_speed_m_s: float) -> bool:
        """Return whether the motion to a pose is impossible.

        Images alone do not distinguish two rooms with the same furniture. The motion is that since the last
        tracked frame, and that since the keyframe that was recognised, if it is of another sub-map.

        Args:
            tracked_pose: The pose.
            last: The last tracked frame.
            usual_speed_m_s: Median speed of the frames before; 0 if it is not known.
        """
        known = self._map.keyframes[tracked_pose.reference]
        since = last if known.origin == self._map.keyframes[last.reference].origin else known
        T_begin_end = inverse(since.body_pose) @ tracked_pose.body_pose
        check = self._motion_check
        if check is not None and check.contradiction(T_begin_end, since.stamp_ns, tracked_pose.stamp_ns):
            return True
        if not is_gap(since.stamp_ns, tracked_pose.stamp_ns):
            return False
        elapsed_ns = tracked_pose.stamp_ns - since.stamp_ns
        distance_m = float(np.linalg.norm(T_begin_end[:3, 3]))
        return distance_m > fastest_m_s(usual_speed_m_s) * elapsed_ns / NS_PER_S

    def is_contradicted(self, tracked_pose: TrackedPose, last: TrackedPose) -> bool:
        """Return whether a pose after a gap is contradicted by what should be in view."""
        return is_gap(last.stamp_ns, tracked_pose.stamp_ns) and (
            self._agrees_in_part(tracked_pose) or self._looks_different(tracked_pose)
        )

    def _agrees_in_part(self, tracked_pose: TrackedPose) -> bool:
        """Return whether only a small part of what a pose has in view supports it.

        What hangs on two walls is found by the wrong one as well, but nothing of what should be around it.
        """
        observation = tracked_pose.observation
        is_inlier = tracked_pose.landmark_of_feature >= 0
        inliers = _by_parts(observation.pixels[is_inlier], observation.size_px)
        missing = _by_parts(self._search.missing_in_view(tracked_pose), observation.size_px)
        counts = inliers + missing >= _MIN_LANDMARKS
        inliers, expected = inliers[counts], (inliers + missing)[counts]
        share = expected / max(expected.sum(), 1)
        usual = float((1.0 - (1.0 - share) ** inliers.sum()).sum())
        return bool((inliers > 0).sum() < _MIN_SPREAD * usual)

    def _looks_different(self, tracked_pose: TrackedPose) -> bool:
        """Return whether the images of the place contradict a pose.

        What is between the features counts here as well. An image is compared with that of the keyframe,
        among those that share most landmarks, which shows most of its surfaces.
        """
        frame = tracked_pose.observation.reduced_frame()
        if frame is None:
            return False
        agreements = [self._agreement(frame, tracked_pose, k) for k in self._sharing(tracked_pose)]
        widest = max(agreements, key=lambda agreement: agreement.compared, default=NOTHING_COMPARED)
        if widest.compared == 0:
            return False
        return widest.same_ratio < _MIN_SAME or widest.local_correlation < _MIN_LOCAL_CORRELATION

    def _sharing(self, tracked_pose: TrackedPose) -> list[int]:
        """Return the keyframes that share most landmarks with a pose."""
        ids = tracked_pose.landmark_of_feature
        counts = self._map.shared_counts(ids[ids >= 0])
        return [int(k) for k in np.argsort(-counts, kind="stable")[:_KEYFRAMES] if counts[k] > 0]

    def _agreement(self, frame: RgbdFrame, tracked_pose: TrackedPose, k: int) -> ImageAgreement:
        shown = self._map.observation(k).reduced_frame()
        if shown is None:
            return NOTHING_COMPARED
        T_keyframe_camera = self._map.keyframes[k].T_camera_world @ inverse(tracked_pose.T_camera_world)
        return image_agreement(frame, shown, T_keyframe_camera)


def _by_parts(pixels: Array, size_px: tuple[int, int]) -> NDArray[np.intp]:
    """Return how many of (N, 2) pixels lie in each part of the image."""
    column, row = (pixels / size_px * (_COLUMNS, _ROWS)).astype(np.intp).T
    part = row.clip(0, _ROWS - 1) * _COLUMNS + column.clip(0, _COLUMNS - 1)
    return np.bincount(part, minlength=_COLUMNS * _ROWS)
