"""Pose tracker by P3P against the latest keyframes (Zhao et al. 2020, §1.2)."""

from collections.abc import Iterator

from mapper.core.geometry import Transform, inverse
from mapper.odometry.camera.image_observation import ImageObservation
from mapper.odometry.keyframes.landmarks import LandmarkMap
from mapper.odometry.keyframes.pose_tracker import TrackedPose
from mapper.odometry.keyframes.relocalizer import Relocalizer


class PnpPoseTracker:
    """Pose tracker without prediction: frames are matched by visual words and their pose is found by P3P."""

    def __init__(self, landmark_map: LandmarkMap, relocalizer: Relocalizer) -> None:
        self._map = landmark_map
        self._relocalizer = relocalizer

    def track(
        self, observation: ImageObservation, last: TrackedPose, _T_predicted: Transform | None, /
    ) -> TrackedPose | None:
        """Match the latest keyframes, and the similar ones as well while few landmarks agree."""
        return self._relocalizer.best_among(self._candidates(observation, last), observation, method="pnp")

    def _candidates(self, observation: ImageObservation, last: TrackedPose) -> Iterator[int]:
        latest = self._map.latest(last.reference)
        yield from latest
        here_world = inverse(last.T_camera_world)[:3, 3]
        yield from (k for k in self._relocalizer.candidates(observation, here_world) if k not in latest)
