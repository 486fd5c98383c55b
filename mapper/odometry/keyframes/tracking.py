"""Tracking: the pose of a frame in the local map, by landmarks and depth, or by relocalisation."""

from functools import partial

from mapper.core.geometry import Array, Transform, adjoint, inverse
from mapper.odometry.base import MotionCheck, is_gap
from mapper.odometry.camera.image_observation import ImageObservation
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.keyframes.depth_tracker import DepthTracker
from mapper.odometry.keyframes.keyframe import Keyframe
from mapper.odometry.keyframes.landmarks import LandmarkMap
from mapper.odometry.keyframes.pose_tracker import PoseTracker, TrackedPose, unmatched
from mapper.odometry.keyframes.relocalizer import Relocalizer
from mapper.odometry.motion_prior import MotionPrior

_MIN_START_FEATURES = 100
"""Features with depth that a sub-map's first frame must have: a few times ``min_inliers``."""
MOST_LOST_FRAMES = 15
"""Frames in a row with enough features but no known landmarks after which a sub-map begins."""


class Tracking:
    """Tracking (Mur-Artal, Montiel & Tardós 2015, §V), which is lost after a frame without a pose."""

    def __init__(
        self,
        config: KeyframeOdometryConfig,
        landmark_map: LandmarkMap,
        relocalizer: Relocalizer,
        tracker: PoseTracker,
        motion_check: MotionCheck | None,
        prior: MotionPrior,
    ) -> None:
        """Start before the first frame.

        Args:
            config: Settings.
            landmark_map: The local map.
            relocalizer: Finds poses without a prediction.
            tracker: Finds poses of frames that follow a tracked one.
            motion_check: Rules out poses after a gap; None if nothing but the images tells of the motion.
            prior: Rules out poses that contradict a gyroscope.
        """
        self._map = landmark_map
        self._relocalizer = relocalizer
        self._tracker = tracker
        self._motion_check = motion_check
        self._prior = prior
        self._depth = DepthTracker(config, landmark_map)
        self._unknown_frames = 0  # since the last pose, those with enough features to begin a sub-map
        self.is_lost = False

    def find_pose(
        self, observation: ImageObservation, last: TrackedPose, T_predicted: Transform | None
    ) -> TrackedPose | None:
        """Track from the last frame; if that fails, or it was lost, relocalise among similar keyframes.

        Args:
            observation: The frame.
            last: The last frame that was tracked.
            T_predicted: T_camera_world (4, 4) by the motion since; None if nothing tells it.
        """
        tracked_pose = None if self.is_lost else self._follow(observation, last, T_predicted)
        if tracked_pose is None:
            tracked_pose = self._relocalise(observation, last)
        self.is_lost = tracked_pose is None
        if tracked_pose is not None:
            self._unknown_frames = 0
        return tracked_pose

    def lose(self, observation: ImageObservation, *, is_first: bool) -> bool:
        """Take a frame as lost; return whether a sub-map begins with it: the first, or after enough."""
        self.is_lost = True
        has_features = observation.has_depth.sum() >= _MIN_START_FEATURES
        if not has_features and not (is_first and self._depth.can_start(observation)):
            return False
        self._unknown_frames += 1
        return is_first or self._unknown_frames > MOST_LOST_FRAMES

    def begin_sub_map(self, observation: ImageObservation, last: TrackedPose | None) -> TrackedPose:
        """Return the pose of a sub-map's first frame: the world's origin, or the last tracked pose."""
        self.is_lost, self._unknown_frames = False, 0
        self._depth.began(observation)
        T_camera_world = inverse(observation.T_body_camera) if last is None else last.T_camera_world
        return TrackedPose(observation, T_camera_world, unmatched(observation), 0, 0, 0, 0.0, "start")

    def information(self, tracked_pose: TrackedPose) -> Array:
        """Return the (6, 6) information of a pose from its landmarks and depth, in the body's tangent."""
        observation = tracked_pose.observation
        information = self._map.pose_information(
            observation, tracked_pose.T_camera_world, tracked_pose.landmark_of_feature
        )
        if tracked_pose.depth is not None:
            to_camera = adjoint(inverse(observation.T_body_camera))
            information = information + to_camera.T @ tracked_pose.depth.information @ to_camera
        return information

    def _follow(
        self, observation: ImageObservation, last: TrackedPose, T_predicted: Transform | None
    ) -> TrackedPose | None:
        tracked_pose = self._tracker.track(observation, last, T_predicted)
        if tracked_pose is not None and self._turns_otherwise(tracked_pose, last):
            tracked_pose = None
        tracked_pose = self._depth.supported(observation, last, T_predicted, tracked_pose)
        if tracked_pose is None or self._turns_otherwise(tracked_pose, last):
            return None
        is_known = self._is_steady(tracked_pose, last) or self._is_possible(tracked_pose, last)
        return tracked_pose if is_known else None

    def _relocalise(self, observation: ImageObservation, last: TrackedPose) -> TrackedPose | None:
        is_possible = partial(self._is_possible, last=last)
        candidates = self._relocalizer.candidates(observation, inverse(last.T_camera_world)[:3, 3])
        relocalised = self._relocalizer.best_among(
            candidates, observation, method="relocalised", is_possible=is_possible, exhaustive=True
        )
        if relocalised is None and is_gap(last.stamp_ns, observation.stamp_ns):
            return None  # depth alone needs a guess, and by now the camera may be in another room
        found = self._depth.supported(observation, relocalised or last, None, relocalised)
        return found if found is not None and is_possible(found) else None

    def _turns_otherwise(self, tracked_pose: TrackedPose, since: TrackedPose | Keyframe) -> bool:
        R_since_body = since.body_pose[:3, :3].T @ tracked_pose.body_pose[:3, :3]
        return self._prior.reject(since.stamp_ns, tracked_pose.stamp_ns, R_since_body)

    def _is_steady(self, tracked_pose: TrackedPose, last: TrackedPose) -> bool:
        """Return whether a pose is soon after the last one, and in its sub-map."""
        keyframes = self._map.keyframes
        is_one_map = keyframes[tracked_pose.reference].origin == keyframes[last.reference].origin
        return is_one_map and not is_gap(last.stamp_ns, tracked_pose.stamp_ns)

    def _is_possible(self, tracked_pose: TrackedPose, last: TrackedPose) -> bool:
        """Return whether a pose after a gap is possible by the motion since, where something else tells it.

        Looks alone cannot tell two rooms apart that are furnished alike. The motion is that since the last
        tracked frame, and that since the keyframe that was recognised, if it is of another sub-map.
        """
        check = self._motion_check
        keyframes = self._map.keyframes
        known = keyframes[tracked_pose.reference]
        since = last if known.origin == keyframes[last.reference].origin else known
        if self._turns_otherwise(tracked_pose, since):
            return False
        T_begin_end = inverse(since.body_pose) @ tracked_pose.body_pose
        if check is None or not check.contradiction(T_begin_end, since.stamp_ns, tracked_pose.stamp_ns):
            return True
        self._unknown_frames = MOST_LOST_FRAMES  # another place, so a sub-map may begin at once
        return False
