"""Frames lost in a row, and the decision whether a new sub-map begins with one of them."""

from mapper.odometry.base import is_gap
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.local_map.depth.depth_alignment import observes_all
from mapper.odometry.local_map.landmarks.landmark_map import LandmarkMap
from mapper.odometry.local_map.observation.depth_surfaces import surface_of
from mapper.odometry.local_map.observation.image_observation import ImageObservation
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose

_MIN_START_FEATURES = 100
"""Features with depth that a sub-map's first frame must have: a few times ``min_inliers``."""
_MIN_FIRST_FEATURES = 70
"""Those that the log's first sub-map needs: later ones may begin on a hand before the lens."""


class LostFrames:
    """Number of the frames lost since the last tracked one, after which a new sub-map begins."""

    def __init__(self, config: KeyframeOdometryConfig, landmark_map: LandmarkMap) -> None:
        self._most = config.max_lost_frames
        self._map = landmark_map
        self.restart()

    def restart(self) -> None:
        """Begin anew with a tracked frame."""
        self.count = 0
        self._unknown = 0  # those with enough features to begin a sub-map

    def begin_at_once(self) -> None:
        """Let a sub-map begin as soon as a frame has enough features."""
        self._unknown = self._most

    def begins_sub_map(self, observation: ImageObservation, last: TrackedPose | None) -> bool:
        """Return whether a sub-map begins with the next frame without a pose, given the last tracked one."""
        enough = _MIN_FIRST_FEATURES if last is None else _MIN_START_FEATURES
        if observation.has_depth.sum() >= enough:
            self._unknown += 1
            return last is None or 0 < self._most < self._unknown
        is_open = last is None or (self._most > 0 and self._is_out_of_reach(last, observation))
        cells = observation.depth_cells
        return is_open and cells is not None and observes_all(surface_of(cells))

    def _is_out_of_reach(self, last: TrackedPose, observation: ImageObservation) -> bool:
        """Return whether a sub-map without texture ended too long ago: nothing in it is recognised."""
        origin = self._map.observation(self._map.keyframes[last.reference].origin)
        is_bare = all(there.has_depth.sum() < _MIN_START_FEATURES for there in (last.observation, origin))
        return is_bare and is_gap(last.stamp_ns, observation.stamp_ns)
