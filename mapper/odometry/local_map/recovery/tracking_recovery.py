"""Recovery of tracking that followed the motion of something else, by keyframes without doubt."""

from dataclasses import replace

import numpy as np

from mapper.core.doubts import Doubt
from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.local_map.depth.earlier_depth import Displacement, EarlierDepth
from mapper.odometry.local_map.landmarks.landmark_map import MIN_SHARED_LANDMARKS, LandmarkMap
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose
from mapper.odometry.local_map.recovery.relocalizer import Relocalizer

_MOST = 0.5
"""Share of displaced surfaces from which another pose is sought."""
_LESS = 0.5
"""Another pose displaces at most this share of what the tracked one does."""
_FASTEST_M_S = 3.0
"""Speed of someone who runs: tracking that followed them is no farther off than that leads in the time around
doubtful keyframes. Things that look alike have been recognised 3 m away while 300 features agreed with the
right pose."""
_SINCE_NS = 5 * NS_PER_S
"""After a doubtful keyframe the keyframes before it are searched for so long."""


class TrackingRecovery:
    """Search for another pose where surfaces lie elsewhere, or where a doubtful keyframe began another map.

    The map that a wrong pose has extended is consistent with it, so that tracking alone does not recover.
    """

    def __init__(
        self,
        config: KeyframeOdometryConfig,
        landmark_map: LandmarkMap,
        relocalizer: Relocalizer,
        earlier_depth: EarlierDepth,
    ) -> None:
        self._config = config
        self._map = landmark_map
        self._relocalizer = relocalizer
        self._earlier_depth = earlier_depth

    def relocalised(
        self, tracked_pose: TrackedPose, displaced: Displacement, twist_camera: Array | None
    ) -> tuple[TrackedPose, Displacement] | None:
        """Return another pose of a frame, which is doubtful, and what it displaces; None if there is none.

        Args:
            tracked_pose: The pose that was tracked.
            displaced: Surfaces that lie elsewhere by it.
            twist_camera: (6,) velocity of the camera in its own axes, rad/s and m/s; None if it is unknown.
        """
        is_displaced = max(displaced.ratio, displaced.far_ratio) > _MOST
        before = self._first_doubtful(tracked_pose)
        if not is_displaced and (before is None or self._is_linked(tracked_pose, before)):
            return None
        observation = tracked_pose.observation

        def displacement(pose: TrackedPose) -> Displacement:
            compared_with = tracked_pose if is_displaced else pose
            return self._earlier_depth.displacement(
                observation, pose.T_camera_world, compared_with.reference, twist_camera
            )

        def is_possible(pose: TrackedPose) -> bool:
            there = displacement(pose)
            if there.since_s == 0.0:
                return False  # nothing is compared
            if is_displaced:
                return (
                    there.ratio <= _LESS * displaced.ratio and there.far_ratio <= _LESS * displaced.far_ratio
                )
            if before is not None and _distance_m(pose, tracked_pose) > self._reach_m(tracked_pose, before):
                return False
            enough = 2 * pose.inliers >= self._config.weak_inliers
            return enough and max(there.ratio, there.far_ratio) <= _MOST

        found = self._relocalizer.best_among(
            self._undoubted(tracked_pose, before), observation, method="relocalised", is_possible=is_possible
        )
        if found is None:
            return None
        text = f"recognised {_distance_m(found, tracked_pose):.2f} m from where the frames before it led"
        displaced = self._earlier_depth.displacement(
            observation, found.T_camera_world, found.reference, twist_camera
        )
        return replace(found, doubts=(*found.doubts, Doubt("recognised elsewhere", text))), displaced

    def is_contradicted(self, tracked_pose: TrackedPose, displaced: Displacement) -> bool:
        """Return whether the depth image contradicts a pose that few landmarks agree with, after a gap.

        A poster that hangs in two places gives some 30 inliers. Without frames before, nothing else tells.
        """
        is_weak = tracked_pose.inliers < self._config.weak_inliers
        return is_weak and min(displaced.ratio, displaced.far_ratio) > _MOST

    def _undoubted(self, tracked_pose: TrackedPose, before: int | None) -> list[int]:
        """Return the sub-map's most similar keyframes without doubt, if given only those before another."""
        keyframes = self._map.keyframes
        origin, end = keyframes[tracked_pose.reference].origin, len(keyframes) if before is None else before
        similar = self._relocalizer.similar(tracked_pose.observation, limit=len(keyframes))
        undoubted = [
            k for k in similar if keyframes[k].origin == origin and keyframes[k].doubt_m == 0.0 and k < end
        ]
        return undoubted[: self._config.relocalisation_keyframes]

    def _first_doubtful(self, tracked_pose: TrackedPose) -> int | None:
        """Return the first doubtful keyframe of the sub-map in the last seconds; None if there is none."""
        keyframes, since_ns = self._map.keyframes, tracked_pose.stamp_ns - _SINCE_NS
        origin, first = keyframes[tracked_pose.reference].origin, None
        for k in range(len(keyframes) - 1, origin, -1):
            if keyframes[k].stamp_ns < since_ns:
                break
            if keyframes[k].doubt_m > 0.0 and keyframes[k].origin == origin:
                first = k
        return first

    def _reach_m(self, tracked_pose: TrackedPose, before: int) -> float:
        """Return how far off poses may be since a first doubtful keyframe, by the time next to such ones."""
        since = self._map.keyframes[before - 1 :]
        doubtful = np.array([keyframe.doubt_m > 0.0 for keyframe in since])
        stamps_ns = np.array([keyframe.stamp_ns for keyframe in since] + [tracked_pose.stamp_ns])
        counts = doubtful | np.append(doubtful[1:], False)
        return _FASTEST_M_S * float(np.diff(stamps_ns)[counts].sum()) / NS_PER_S

    def _is_linked(self, tracked_pose: TrackedPose, before: int) -> bool:
        """Return whether a pose rests on landmarks that a keyframe before another one observes."""
        ids = tracked_pose.landmark_of_feature
        counts = self._map.shared_counts(ids[ids >= 0])
        return bool(counts[:before].max(initial=0) >= MIN_SHARED_LANDMARKS)


def _distance_m(a: TrackedPose, b: TrackedPose) -> float:
    return float(np.linalg.norm(a.body_pose[:3, 3] - b.body_pose[:3, 3]))
