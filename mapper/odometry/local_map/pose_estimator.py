"""Pose of a frame in the local map: tracked from the frame before it, else relocalised among keyframes."""

from collections.abc import Callable
from functools import partial

from mapper.core.geometry import Transform, inverse
from mapper.odometry.base import MotionCheck, is_gap
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.local_map.depth_tracker import DepthTracker
from mapper.odometry.local_map.landmarks.landmark_map import LandmarkMap
from mapper.odometry.local_map.observation.image_observation import ImageObservation
from mapper.odometry.local_map.pose.pose_tracker import PoseTracker, TrackedPose, unmatched
from mapper.odometry.local_map.recovery.gap_check import GapCheck
from mapper.odometry.local_map.recovery.lost_frames import LostFrames
from mapper.odometry.local_map.recovery.relocalizer import Relocalizer


class PoseEstimator:
    """Estimator of frames' poses by landmarks and depth; what contradicts a pose after a gap rules it out."""

    def __init__(
        self,
        config: KeyframeOdometryConfig,
        landmark_map: LandmarkMap,
        relocalizer: Relocalizer,
        tracker: PoseTracker,
        motion_check: MotionCheck | None,
        lost: LostFrames,
    ) -> None:
        self._relocalizer = relocalizer
        self._tracker = tracker
        self._depth = DepthTracker(config, landmark_map)
        self._gap_check = GapCheck(config, landmark_map, motion_check)
        self._lost = lost

    def first_of_sub_map(self, observation: ImageObservation, last: TrackedPose | None) -> TrackedPose:
        """Return the pose of a sub-map's first frame: that of the last tracked one, or the world's origin."""
        self._lost.restart()
        self._depth.began(observation)
        T_camera_world = inverse(observation.T_body_camera) if last is None else last.T_camera_world
        return TrackedPose(observation, T_camera_world, unmatched(observation), 0, 0, 1.0, 0, 0.0, "start")

    def estimate(
        self,
        observation: ImageObservation,
        last: TrackedPose,
        T_predicted: Transform | None,
        usual_speed_m_s: float,
    ) -> TrackedPose | None:
        """Return a frame's pose, with a doubt if it follows a gap and may be of another place.

        Args:
            observation: The frame.
            last: The last frame that was tracked.
            T_predicted: (4, 4) predicted T_camera_world; None if nothing predicts it.
            usual_speed_m_s: Median speed of the frames before; 0 if it is not known.

        Returns:
            The pose; None if it is not found.
        """
        is_possible = partial(self._is_possible, last=last, usual_speed_m_s=usual_speed_m_s)
        found = None if self._lost.count else self._tracked(observation, last, T_predicted)
        if found is None or (self._gap_check.is_needed(found, last) and not is_possible(found)):
            found = self._relocalised(observation, last, is_possible)
        if found is None or not is_gap(last.stamp_ns, observation.stamp_ns):
            return found
        return self._relocalizer.compared_with_other_places(found)

    def _tracked(
        self, observation: ImageObservation, last: TrackedPose, T_predicted: Transform | None
    ) -> TrackedPose | None:
        """Track from the last frame by landmarks, and by depth where these do not suffice."""
        found = self._tracker.track(observation, last, T_predicted)
        if found is None and T_predicted is None:
            return None  # depth may lead into a wrong minimum, so keyframes are recognised first
        return self._depth.supported(observation, last, T_predicted, found)

    def _relocalised(
        self, observation: ImageObservation, last: TrackedPose, is_possible: Callable[[TrackedPose], bool]
    ) -> TrackedPose | None:
        """Recognise a similar or near keyframe; within a second, depth alone may find the pose as well."""
        candidates = self._relocalizer.candidates(observation, inverse(last.T_camera_world)[:3, 3])
        recognised = self._relocalizer.best_among(
            candidates, observation, method="relocalised", is_possible=is_possible, exhaustive=True
        )
        if recognised is None and is_gap(last.stamp_ns, observation.stamp_ns):
            return None  # depth alone needs a guess, and by now the camera may be in another room
        found = self._depth.supported(observation, recognised or last, None, recognised)
        return found if found is not None and is_possible(found) else None

    def _is_possible(self, tracked_pose: TrackedPose, *, last: TrackedPose, usual_speed_m_s: float) -> bool:
        """Return whether a pose after a gap is possible by the motion to it and by what should be in view."""
        if self._gap_check.is_out_of_reach(tracked_pose, last, usual_speed_m_s):
            self._lost.begin_at_once()  # this is another place
            return False
        return not self._gap_check.is_contradicted(tracked_pose, last)
