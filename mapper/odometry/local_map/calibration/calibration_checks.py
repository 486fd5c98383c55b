"""Checks of a camera's calibration against what its images show, by windows of keyframes."""

from collections.abc import Sequence

from mapper.odometry.local_map.bundle.bundle import WINDOW_KEYFRAMES
from mapper.odometry.local_map.calibration.depth_image_check import DepthImageCheck
from mapper.odometry.local_map.calibration.intrinsics_check import IntrinsicsCheck
from mapper.odometry.local_map.landmarks.landmark_map import LandmarkMap
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose


class CalibrationChecks:
    """Checks of the intrinsics, and of where and when depth images show what colour images do."""

    def __init__(self, landmark_map: LandmarkMap) -> None:
        """Start with an empty map."""
        self._map = landmark_map
        self._intrinsics = IntrinsicsCheck()
        self._depth_images = DepthImageCheck()

    def pass_frame(self, before: TrackedPose | None, last: TrackedPose, now: TrackedPose) -> None:
        """Estimate the velocity of a keyframe from the frames about it, unless something moves by itself."""
        if before is None or self._map.keyframes[last.reference].stamp_ns != last.stamp_ns:
            return
        if all(pose.few_move for pose in (before, last, now)):
            around = ((pose.stamp_ns, pose.T_camera_world) for pose in (before, now))
            self._depth_images.pass_keyframe(last.reference, *around)

    def pass_keyframe(self) -> None:
        """Check the newest keyframes of a sub-map together, once there are enough since the last check."""
        keyframes = self._map.keyframes
        newest = range(len(keyframes) - WINDOW_KEYFRAMES, len(keyframes))
        origins = {keyframes[k].origin for k in newest if k >= 0}
        if len(keyframes) % WINDOW_KEYFRAMES or len(origins) > 1:
            return
        if self._intrinsics.is_complete and self._depth_images.is_complete:
            return
        bundle = self._map.bundle(newest)
        if not self._intrinsics.is_complete:
            self._intrinsics.add(bundle)
        if not self._depth_images.is_complete:
            self._depth_images.add(bundle, newest, map(self._map.observation, newest))

    def contradictions(self) -> Sequence[str]:
        """Return what contradicts the calibration and the stamps of depth images, a sentence each."""
        if not self._map.keyframes:
            return ()
        doubts = self._depth_images.contradictions()
        if self._depth_images.are_registered:  # else depth of other pixels falsifies the intrinsics
            doubts += self._intrinsics.contradictions(self._map.observation(0).intrinsics)
        return doubts
