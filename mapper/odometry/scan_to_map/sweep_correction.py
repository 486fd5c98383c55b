"""Correction of the scan before the last one by the velocity that the poses around it show."""

import copy
from dataclasses import dataclass, replace

import numpy as np

from mapper.graph.model import BetweenFactor
from mapper.odometry.base import FrameResult
from mapper.odometry.scan_to_map.motion_model import covariance_unmeasured, velocities_at
from mapper.odometry.scan_to_map.placed_scan import PlacedScan
from mapper.odometry.scan_to_map.scan_observation import ScanObservation
from mapper.odometry.scan_to_map.scan_placement import ScanPlacement
from mapper.odometry.scan_to_map.scan_state import ScanState
from mapper.odometry.scan_to_map.scan_tracker import ScanTracker


@dataclass(frozen=True, slots=True, eq=False)
class TrackedScan:
    """A scan whose velocity the next scan may correct.

    Attributes:
        first: First scan of its map, if it is the second one.
        observation: The scan.
        placed: Its pose.
        result: What was returned for it.
        state: Before it was tracked.
    """

    first: ScanObservation | None
    observation: ScanObservation
    placed: PlacedScan
    result: FrameResult
    state: ScanState


class SweepCorrection:
    """Correction of scans whose sweeps may be bent, once the next scan is placed.

    Attributes:
        waiting: Factor of the last scan, if the next one may correct it.
    """

    def __init__(self, state: ScanState, placement: ScanPlacement, tracker: ScanTracker) -> None:
        self.waiting: tuple[BetweenFactor, ...] = ()
        self._state = state
        self._placement = placement
        self._tracker = tracker
        self._before: TrackedScan | None = None
        self._corrections: dict[int, FrameResult] = {}  # of scans that were tracked again, by their stamps

    def follow(self, result: FrameResult, scan: TrackedScan | None) -> FrameResult:
        """Return a scan's result with the factors that are final now.

        Args:
            result: As tracked.
            scan: The scan, if the next one may correct it: its own factor waits.
        """
        waiting, own = self.waiting, tuple(result.factors)
        self._before = scan
        self.waiting = () if scan is None else own
        return replace(result, factors=(*waiting, *own) if scan is None else waiting)

    def placed_after(self, observation: ScanObservation, placed: PlacedScan) -> PlacedScan:
        """Return a scan's pose after the scan before it was tracked again, if its velocity was off.

        Three poses show the velocity at the one between better than the sweep does. What it leads to counts
        if no evidence is against it and both scans fit no less than before. At a corner neither is sure:
        poses stay, and the difference of both is an error of the way to the stamp.
        """
        before, motion = self._before, self._state.motion
        if before is None:
            return placed
        earlier, time_ns = before.state.motion, before.observation.middle_ns
        velocities = velocities_at(
            (earlier.T_world_last, motion.T_world_last, placed.found.T_world_middle),
            (earlier.elapsed_s(time_ns), motion.elapsed_s(observation.middle_ns)),
        )
        if velocities is None:
            return placed
        at_first, twist, change = velocities
        off_radps = float(np.linalg.norm(twist.rotation_radps - motion.twist.rotation_radps))
        if not before.observation.is_bent_by(off_radps):
            return placed
        changes = np.maximum(earlier.velocity_sigmas(time_ns), change)
        again = replace(before.placed, twist=twist, velocity_covariance=covariance_unmeasured(changes))
        now = copy.copy(self._state)
        self._state.restore(before.state)
        if before.placed.turns_otherwise(again):
            contradicted = replace(before.placed, contradiction_radps=off_radps)
            self._take(self._tracker.track(before.observation, contradicted))
            keyframe = self._state.keyframe_of(placed.found.keyframe.node)
            return replace(placed, found=replace(placed.found, keyframe=keyframe))
        if before.first is not None:
            self._state.begin_again(before.first, at_first, float(np.linalg.norm(change[:3])))
        again = replace(again, deskewed=before.observation.deskew(twist))
        corrected = self._tracked_again(before, again, observation, placed)
        if corrected is None:
            self._state.restore(now)
        return corrected or placed

    def _tracked_again(
        self, before: TrackedScan, again: PlacedScan, observation: ScanObservation, placed: PlacedScan
    ) -> PlacedScan | None:
        """Track a scan again, and place the next one after it; None if that is no better.

        Args:
            before: The scan as it was tracked.
            again: With the velocity by which it is tracked again; its pose is searched from the one it had.
            observation: The next scan.
            placed: As it was placed before.
        """
        found = self._placement.pose_of(
            again.deskewed, before.observation.middle_ns, before.placed.found.T_world_middle
        )
        if found is None:
            return None
        result = self._tracker.track(before.observation, replace(again, found=found))
        is_same = (result.node, result.is_keyframe) == (before.result.node, before.result.is_keyframe)
        if result.doubts or not is_same:
            return None
        corrected = self._placement.place(observation, placed)
        score = before.placed.found.score + placed.found.score
        if corrected is None or found.score + corrected.found.score < score:
            return None
        self._take(result)
        return corrected

    def _take(self, result: FrameResult) -> None:
        """Take over the result of a scan that was tracked again."""
        self._corrections[result.stamp_ns], self.waiting = result, tuple(result.factors)

    def corrected(self, result: FrameResult) -> FrameResult:
        """Return the result of a scan; if it was tracked again, with the pose and the doubts of that."""
        again = self._corrections.get(result.stamp_ns)
        if again is None:
            return result
        return replace(
            result,
            T_node_body=again.T_node_body,
            doubts=again.doubts,
            covariance=again.covariance,
            unseen=again.unseen,
        )
