"""Checks of a camera's calibration against what its images show, by windows of keyframes."""

from collections.abc import Sequence

from mapper.odometry.local_map.bundle import WINDOW_KEYFRAMES
from mapper.odometry.local_map.depth_offset import DepthOffsetCheck
from mapper.odometry.local_map.intrinsics_check import IntrinsicsCheck
from mapper.odometry.local_map.landmarks import LandmarkMap
from mapper.odometry.local_map.pose_tracker import TrackedPose
from mapper.odometry.local_map.registration_check import RegistrationCheck


class CalibrationChecks:
    """Checks of the intrinsics, of the registration of depth, and of the time between the two images."""

    def __init__(self, landmark_map: LandmarkMap) -> None:
        """Start with an empty map."""
        self._map = landmark_map
        self._intrinsics = IntrinsicsCheck()
        self._registration = RegistrationCheck()
        self._depth_offset = DepthOffsetCheck()

    def pass_frame(self, before: TrackedPose | None, last: TrackedPose, now: TrackedPose) -> None:
        """Estimate the velocity of a keyframe from the frames about it, unless something moves by itself."""
        if before is None or self._map.keyframes[last.reference].stamp_ns != last.stamp_ns:
            return
        if all(pose.few_move for pose in (before, last, now)):
            around = ((pose.stamp_ns, pose.T_camera_world) for pose in (before, now))
            self._depth_offset.pass_keyframe(last.reference, *around)

    def pass_keyframe(self) -> None:
        """Check the newest keyframes of a sub-map together, once there are enough since the last check."""
        keyframes = self._map.keyframes
        newest = range(len(keyframes) - WINDOW_KEYFRAMES, len(keyframes))
        origins = {keyframes[k].origin for k in newest if k >= 0}
        if len(keyframes) % WINDOW_KEYFRAMES or len(origins) > 1:
            return
        checks = self._intrinsics, self._registration, self._depth_offset
        if all(check.is_complete for check in checks):
            return
        bundle = self._map.bundle(newest)
        if not self._intrinsics.is_complete:
            self._intrinsics.add(bundle)
        if not self._registration.is_complete:
            self._registration.add(bundle, map(self._map.observation, newest))
        if not self._depth_offset.is_complete:
            self._depth_offset.add(bundle, newest, map(self._map.observation, newest))

    def contradictions(self) -> Sequence[str]:
        """Return what contradicts the calibration and the stamps of depth images, a sentence each."""
        if not self._map.keyframes:
            return ()
        found = (
            self._intrinsics.contradiction(self._map.observation(0).intrinsics),
            self._registration.contradiction(),
            self._depth_offset.contradiction(),
        )
        return [sentence for sentence in found if sentence]
