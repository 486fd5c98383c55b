"""Scan-to-map odometry by any scan matcher, with checks of each pose against the last keyframe."""

from collections.abc import Sequence

import numpy as np

from mapper.core.deskew import Twist
from mapper.core.frames import Frame
from mapper.core.geometry import Transform
from mapper.features.frame_view import ScanView
from mapper.graph.model import BetweenFactor
from mapper.odometry.base import Diagnostics, FrameOdometry, FrameResult, lost_frame
from mapper.odometry.scan_to_map.config import ScanOdometryConfig
from mapper.odometry.scan_to_map.first_sweep import FirstSweep
from mapper.odometry.scan_to_map.pose_search import PoseSearch
from mapper.odometry.scan_to_map.scan_matcher import ScanMatcher
from mapper.odometry.scan_to_map.scan_observation import ScanObservation, observe_scan
from mapper.odometry.scan_to_map.scan_placement import ScanPlacement
from mapper.odometry.scan_to_map.scan_state import ScanState
from mapper.odometry.scan_to_map.scan_tracker import ScanTracker
from mapper.odometry.scan_to_map.sweep_correction import SweepCorrection, TrackedScan
from mapper.odometry.scan_to_map.unseen_motion_smoothing import smooth_unseen_motions


class ScanOdometry(FrameOdometry[ScanObservation]):
    """Odometry by constant-velocity prediction, a scan matcher, and acceptance by what is usual in this log.

    A pose is compared with the last keyframe: the share of the points that have a partner there, the share
    that agrees in the direction where the least does, the points in space that rays passed, and the jump from
    the predicted pose. What is unusual is searched by other ways; what stays so is doubtful, and where next
    to nothing agrees, lost. A doubtful scan does not enter the map; if it is far, it is a keyframe with an
    inflated covariance, from which tracking goes on once another scan fits it and not the keyframe before.
    Keyframes are the nodes, numbered from 0, each with a factor to an earlier one. Motions that the surfaces
    do not show are predicted, with a covariance that grows until they are seen again.

    Where a sweep may be bent, the next scan's pose shows its velocity better, and it is tracked again with
    that. Its factor waits for this.
    """

    def __init__(self, config: ScanOdometryConfig, matcher: ScanMatcher) -> None:
        self._config = config
        self._state = ScanState(matcher)
        search = PoseSearch(config, self._state)
        self._placement = ScanPlacement(config, self._state, search)
        self._tracker = ScanTracker(config, self._state, search)
        self._first_sweep = FirstSweep(self._state, self._placement)
        self._correction = SweepCorrection(self._state, self._placement, self._tracker)
        self._lost_scans = 0

    def observe(self, frame: Frame) -> ScanObservation:
        """Return a frame's points in range, thinned. Pure.

        Raises:
            FrameError: Too few points are in range.
        """
        return observe_scan(frame, self._config)

    def track(self, observation: ScanObservation) -> FrameResult:
        """Track the next frame, in time order."""
        if not self._state.keyframes:
            return self._start(observation, np.eye(4), method="start")
        first = self._first_sweep.first
        placed = self._placement.place(observation)
        if first is not None:
            placed = self._first_sweep.placed_after(first, observation, placed)
        elif placed is not None:
            placed = self._correction.placed_after(observation, placed)
        if placed is None:
            return self._not_found(observation)
        self._first_sweep.first, self._lost_scans = None, 0
        state = self._state.copy() if self._placement.may_be_bent(observation) else None
        result = self._tracker.track(observation, placed)
        scan = None if state is None else TrackedScan(first, observation, placed, result, state)
        return self._correction.follow(result, scan)

    def _start(self, observation: ScanObservation, T_world_body: Transform, *, method: str) -> FrameResult:
        """Make a scan the first keyframe of a map, unconnected to earlier maps."""
        self._lost_scans = 0
        self._first_sweep.restart(observation)
        self._state.begin_map(observation, T_world_body)
        keyframe = self._state.keyframes[0]
        result = FrameResult(
            stamp_ns=observation.scan.stamp_ns,
            node=keyframe.node,
            T_node_body=np.eye(4),
            T_world_body=T_world_body,
            is_keyframe=True,
            diagnostics=Diagnostics(len(keyframe.deskewed.prepared.points), 0, 0, 0.0, "m", method),
            is_sharp=observation.scan.times_s is None,
        )
        return self._correction.follow(result, None)

    def _not_found(self, observation: ScanObservation) -> FrameResult:
        """Return a lost scan, or begin a new map with it once enough in a row were lost."""
        self._lost_scans += 1
        if 0 < self._config.max_lost_scans < self._lost_scans:
            return self._start(observation, self._state.motion.T_world_last, method="new sub-map")
        scan = observation.scan
        return lost_frame(scan.stamp_ns, self._state.motion.T_world_last, features=len(scan.points_body))

    def finish(self) -> Sequence[BetweenFactor]:
        """Return the factor of the last scan, if it waits for another scan."""
        return self._correction.waiting

    def in_hindsight(self, results: Sequence[FrameResult]) -> list[FrameResult]:
        """Return all results: those of scans tracked again as these are, and unseen motions smoothed."""
        return smooth_unseen_motions([self._correction.corrected(result) for result in results])

    def view(self, observation: ScanObservation, twist: Twist | None = None, /) -> ScanView:
        """Return the view for place recognition. Pure."""
        return observation.view(twist)

    def matches(self) -> None:
        """Return None: the pose is not from features."""
