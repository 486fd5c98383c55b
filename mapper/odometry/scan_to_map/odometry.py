"""Scan-to-map odometry by any scan matcher, with checks of each pose against the last keyframe."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapper.core.deskew import STILL, Twist
from mapper.core.frames import Frame
from mapper.core.geometry import Transform, adjoint, inverse
from mapper.features.frame_view import ScanView
from mapper.graph.model import BetweenFactor
from mapper.odometry.base import Diagnostics, FrameOdometry, FrameResult, lost_frame
from mapper.odometry.keyframe_distance import is_far
from mapper.odometry.scan_to_map.config import ScanOdometryConfig
from mapper.odometry.scan_to_map.keyframe_tree import KeyframeTree
from mapper.odometry.scan_to_map.motion_model import MotionModel, covariance_unmeasured, velocities_at
from mapper.odometry.scan_to_map.pose_search import PoseSearch
from mapper.odometry.scan_to_map.scan_fit import ScanKeyframe
from mapper.odometry.scan_to_map.scan_matcher import DeskewedScan, ScanMatcher
from mapper.odometry.scan_to_map.scan_noise import ScanNoise, doubtful_covariance, information_of
from mapper.odometry.scan_to_map.scan_observation import ScanObservation, observe_scan
from mapper.odometry.scan_to_map.scan_placement import ScanPlacement
from mapper.odometry.scan_to_map.tracked_scan import PlacedScan, ScanState, TrackedScan
from mapper.odometry.scan_to_map.unseen_motion_smoothing import smooth_unseen_motions

_KEYFRAMES = 5  # so many last ones are compared with
_CLEAR = 0.5  # score of a log's second scan; in rooms 0.6 to 0.8 is usual, in fields less
_FIRST_TURNS_RADPS = (1.0, -1.0, 2.0, -2.0, 4.0, -4.0)  # about the vertical, at the beginning of a map
_SHOWN = 0.2  # share of such a turn that the poses show at least, should it end soon after the first sweep


class ScanOdometry(FrameOdometry[ScanObservation]):
    """Odometry by constant-velocity prediction, a scan matcher, and acceptance by what is usual in this log.

    A pose is compared with the last keyframe: the share of the points that have a partner there, the share
    that agrees in the direction where the least does, the points in space that rays passed, and the jump from
    the predicted pose. What is unusual is searched by other ways; what stays so is doubtful, and where next
    to nothing agrees, lost. A doubtful scan does not enter the map; if it is far, it is a keyframe with an
    inflated covariance, from which tracking goes on once another scan fits it and not the keyframe before.
    Keyframes are the nodes, numbered from 0, each with a factor to an earlier one. Motions that the surfaces
    do not show are predicted, with a covariance that grows until they are seen again.

    Where a sweep may be bent, the next scan's pose tells its velocity better, and it is tracked again with
    that. Its factor waits for this.
    """

    def __init__(self, config: ScanOdometryConfig, matcher: ScanMatcher) -> None:
        self._config = config
        self._search = PoseSearch(config, matcher)
        self._placement = ScanPlacement(config, self._search)
        self._state = ScanState(
            matcher,
            self._search.usual,
            ScanNoise(),
            MotionModel(0, np.eye(4)),
            KeyframeTree(4 * _KEYFRAMES),
            deque(maxlen=_KEYFRAMES),
        )
        self._first: ScanObservation | None = None
        self._has_tried_turns = False
        self._before: TrackedScan | None = None
        self._waiting: tuple[BetweenFactor, ...] = ()
        self._again: dict[int, FrameResult] = {}  # of scans that were tracked again, by their stamps
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
        placed = self._placement.place(self._state, observation)
        if self._first is not None and self._first.scan.times_s is not None:
            placed = self._begin_again(self._first, observation, placed)
        elif placed is not None and self._before is not None:
            placed = self._after_correction(self._before, observation, placed)
        if placed is None:
            return self._not_found(observation)
        state = self._state.copy() if self._placement.may_be_bent(self._state, observation) else None
        first, self._first, self._lost_scans = self._first, None, 0
        result = self._placed(observation, placed)
        waiting, self._waiting, self._before = self._waiting, (), None
        if state is None:
            return replace(result, factors=(*waiting, *result.factors))
        self._before = TrackedScan(first, observation, placed, result, state)
        self._waiting = tuple(result.factors)
        return replace(result, factors=waiting)

    def finish(self) -> Sequence[BetweenFactor]:
        """Return the factor of the last scan, if it waits for another scan."""
        return self._waiting

    def in_hindsight(self, results: Sequence[FrameResult]) -> list[FrameResult]:
        """Return all results: those of scans tracked again as these are, and unseen motions smoothed."""
        return smooth_unseen_motions([self._corrected(result) for result in results])

    def _corrected(self, result: FrameResult) -> FrameResult:
        """Return the result of a scan; if it was tracked again, with the pose and the doubts of that."""
        again = self._again.get(result.stamp_ns)
        if again is None:
            return result
        return replace(
            result,
            T_node_body=again.T_node_body,
            doubts=again.doubts,
            covariance=again.covariance,
            unseen=again.unseen,
        )

    def view(self, observation: ScanObservation, twist: Twist | None = None, /) -> ScanView:
        """Return the view for place recognition. Pure."""
        return observation.view(twist)

    def matches(self) -> None:
        """Return None: the pose is not from features."""

    def _begin_again(
        self, first: ScanObservation, second: ScanObservation, placed: PlacedScan | None
    ) -> PlacedScan | None:
        """Track a map's first two scans again, with the motion during their sweeps that the second one shows.

        Where it does not fit clearly, other motions are tried once: the log may begin with a fast turn. Scans
        that are bent alike fit each other, so a motion counts only where the poses show part of it.
        """
        twist = STILL
        if placed is not None:
            twist = self._state.motion.mean_twist(second.middle_ns, placed.found.T_world_middle)
            placed = self._begun(first, second, twist)
            if placed is not None and placed.found.score >= _CLEAR:
                return placed
        if self._has_tried_turns:
            return placed
        self._has_tried_turns = True
        best = -np.inf if placed is None else placed.found.score
        for turning_radps in _FIRST_TURNS_RADPS:
            tried = Twist(np.array([0.0, 0.0, turning_radps]), np.zeros(3))
            for _ in range(2):  # the second time with the mean velocity to the pose that was found
                found = self._begun(first, second, tried)
                if found is None:
                    break
                mean = self._state.motion.mean_twist(second.middle_ns, found.found.T_world_middle)
                shown = mean.rotation_radps @ tried.rotation_radps
                is_shown = shown >= _SHOWN * tried.rotation_radps @ tried.rotation_radps
                if is_shown and found.found.score > best:
                    twist, best = tried, found.found.score
                tried = mean
        return self._begun(first, second, twist)

    def _begun(self, first: ScanObservation, second: ScanObservation, twist: Twist) -> PlacedScan | None:
        """Begin a map with its first scan, deskewed by a velocity, and place the second one in it."""
        turning_radps = float(np.linalg.norm(twist.rotation_radps))
        self._begin(first, twist, turning_radps)  # it may just have begun to turn
        return self._placement.place(self._state, second)

    def _begin(self, first: ScanObservation, twist: Twist, sigma_radps: float) -> None:
        """Begin a map with its first scan again, by a velocity whose rotation has a standard deviation."""
        keyframe = self._state.keyframes[0]
        self._state.matcher.clear()
        self._state.next_node = keyframe.node
        T_world_middle = keyframe.T_world_body @ twist.over(first.middle_s)
        self._state.motion = MotionModel(first.middle_ns, T_world_middle)
        self._state.motion.twist = twist
        self._add_keyframe(first, first.deskew(twist), T_world_middle, sigma_radps)

    def _after_correction(
        self, before: TrackedScan, observation: ScanObservation, placed: PlacedScan
    ) -> PlacedScan:
        """Return a scan's pose after the scan before it was tracked again, if its velocity was off.

        Three poses tell the velocity at the one between better than the sweep does. What it leads to counts
        if no evidence is against it and both scans fit no less than before. At a corner neither is sure:
        poses stay, and the difference of both is an error of the way to the stamp.
        """
        state, time_ns = before.state, before.observation.middle_ns
        T_world_before = self._state.motion.T_world_last
        elapsed_s = state.motion.elapsed_s(time_ns), self._state.motion.elapsed_s(observation.middle_ns)
        velocities = velocities_at(
            (state.motion.T_world_last, T_world_before, placed.found.T_world_middle), elapsed_s
        )
        if velocities is None:
            return placed
        at_first, twist, change = velocities
        off_radps = float(np.linalg.norm(twist.rotation_radps - self._state.motion.twist.rotation_radps))
        changes = np.maximum(state.motion.velocity_sigmas(time_ns), change)
        again = replace(before.placed, twist=twist, velocity_covariance=covariance_unmeasured(changes))
        if not before.observation.is_bent_by(off_radps):
            return placed
        now = self._state
        self._restore(state)
        if before.placed.turns_otherwise(again):
            result = self._placed(before.observation, replace(before.placed, contradiction_radps=off_radps))
            self._again[result.stamp_ns], self._waiting = result, tuple(result.factors)
            keyframe = self._state.keyframe_of(placed.found.keyframe.node)
            return replace(placed, found=replace(placed.found, keyframe=keyframe))
        if before.first is not None:
            self._begin(before.first, at_first, float(np.linalg.norm(change[:3])))
        deskewed = before.observation.deskew(twist)
        found = self._placement.pose_of(self._state, deskewed, time_ns, T_world_before)
        if found is not None:
            result = self._placed(before.observation, replace(again, deskewed=deskewed, found=found))
            is_same = (result.node, result.is_keyframe) == (before.result.node, before.result.is_keyframe)
            corrected = None
            if is_same and not result.doubts:
                corrected = self._placement.place(self._state, observation, placed)
            score = before.placed.found.score + placed.found.score
            if corrected is not None and found.score + corrected.found.score >= score:
                self._again[result.stamp_ns], self._waiting = result, tuple(result.factors)
                return corrected
        self._restore(now)
        return placed

    def _restore(self, state: ScanState) -> None:
        """Go on from a state."""
        self._state = state
        self._search.go_on(state.matcher, state.usual)

    def _placed(self, observation: ScanObservation, placed: PlacedScan) -> FrameResult:
        """Return the result of a scan whose pose was found, and make it a keyframe if it is far."""
        found, deskewed = placed.found, placed.deskewed
        time_ns, keyframe = observation.middle_ns, found.keyframe
        T_key_scan = inverse(keyframe.T_world_middle) @ found.T_world_middle
        at_stamp = observation.middle_s**2 * placed.covariance_to_stamp
        Ad = adjoint(inverse(T_key_scan))
        noise = self._state.noise.of(
            found.fit,
            found.blend,
            T_key_scan,
            inverse(self._state.motion.T_world_last) @ found.T_world_middle,
            self._state.motion.elapsed_s(time_ns),
            at_stamp + Ad @ keyframe.covariance_at_stamp @ Ad.T,
        )
        of_sweep = () if self._config.usual_ratio == 0.0 else observation.doubts(placed.velocity_covariance)
        doubts = (*self._search.doubts(found), *of_sweep)
        fits = not doubts
        if not fits:
            noise = noise.with_more(doubtful_covariance(found.jump))
        elif self._search.usual.is_weak(found.shares):
            noise = noise.with_more(found.fit.weak_covariance(deskewed.prepared.voxel_m))
        if fits and keyframe is self._state.doubtful:
            self._state.matcher.clear()
            self._state.matcher.add(keyframe.deskewed, keyframe.T_world_middle, is_keyframe=True)
            self._state.keyframes.clear()
            self._state.keyframes.appendleft(keyframe)
        self._state.motion.follow(
            time_ns,
            found.T_world_middle,
            is_certain=fits and found.is_measured,
            pose_covariance=noise.independent,
            measured=None if placed.twist is None else (placed.twist, placed.velocity_covariance),
        )
        T_middle_body = self._state.motion.twist.over(-observation.middle_s)
        T_world_body = found.T_world_middle @ T_middle_body
        T_key_body = inverse(keyframe.T_world_body) @ T_world_body
        is_keyframe = is_far(T_key_body, self._config)
        node, covariance = keyframe.node, noise.covariance
        factors: tuple[BetweenFactor, ...] = ()
        scan = ScanKeyframe(self._state.next_node, deskewed, found.T_world_middle, T_world_body, at_stamp)
        if fits:
            self._state.doubtful = None
            self._search.usual.add(found.shares)
            self._state.matcher.add(deskewed, found.T_world_middle, is_keyframe=is_keyframe)
        else:
            self._search.usual.add_doubtful(found.shares)
        if is_keyframe:
            node = self._state.next_node
            self._state.next_node += 1
            self._state.noise.restart()
            factors = (BetweenFactor(keyframe.node, node, T_key_body, information_of(noise.covariance)),)
            covariance = self._state.tree.add(node, keyframe.node, T_world_body, noise.covariance)
            if fits:
                self._state.keyframes.appendleft(scan)
            else:
                self._state.doubtful = scan
        self._state.last = scan
        points = len(deskewed.prepared.points)
        return FrameResult(
            stamp_ns=observation.scan.stamp_ns,
            node=node,
            T_node_body=np.eye(4) if is_keyframe else T_key_body,
            T_world_body=T_world_body,
            is_keyframe=is_keyframe,
            diagnostics=Diagnostics(
                features=points,
                matches=points,
                inliers=len(found.fit.points),
                residual=found.fit.rmse_m,
                residual_unit="m",
                method=found.method,
                unobservable=found.fit.unobservable,
            ),
            factors=factors,
            links=factors,
            twist=self._state.motion.twist,
            doubts=(*doubts, *noise.doubts),
            covariance=covariance,
            unseen=None if noise.unseen is None else noise.unseen.at(T_middle_body),
        )

    def _start(self, observation: ScanObservation, T_world_body: Transform, *, method: str) -> FrameResult:
        """Make a scan the first keyframe of a map, unconnected to earlier maps."""
        self._state.matcher.clear()
        self._search.usual.clear()
        self._state.noise.restart()
        self._lost_scans, self._first, self._before = 0, observation, None
        self._has_tried_turns = False
        waiting, self._waiting = self._waiting, ()
        deskewed = observation.deskew(STILL)
        self._state.motion = MotionModel(observation.middle_ns, T_world_body)
        node = self._add_keyframe(observation, deskewed, T_world_body, 0.0)
        return FrameResult(
            stamp_ns=observation.scan.stamp_ns,
            node=node,
            T_node_body=np.eye(4),
            T_world_body=T_world_body,
            is_keyframe=True,
            factors=waiting,
            diagnostics=Diagnostics(len(deskewed.prepared.points), 0, 0, 0.0, "m", method),
            is_sharp=observation.scan.times_s is None,
        )

    def _not_found(self, observation: ScanObservation) -> FrameResult:
        """Return a lost scan, or begin a new map with it once enough in a row were lost."""
        self._lost_scans += 1
        if 0 < self._config.max_lost_scans < self._lost_scans:
            return self._start(observation, self._state.motion.T_world_last, method="new sub-map")
        scan = observation.scan
        return lost_frame(scan.stamp_ns, self._state.motion.T_world_last, features=len(scan.points_body))

    def _add_keyframe(
        self,
        observation: ScanObservation,
        deskewed: DeskewedScan,
        T_world_middle: Transform,
        sigma_radps: float,
    ) -> int:
        """Make a scan a keyframe without a factor; return its node."""
        self._state.matcher.add(deskewed, T_world_middle, is_keyframe=True)
        twist = self._state.motion.twist
        T_world_body = T_world_middle @ twist.over(-observation.middle_s)
        covariance = np.diag([(observation.middle_s * sigma_radps) ** 2] * 3 + [0.0] * 3)
        self._state.keyframes.clear()
        self._state.keyframes.append(
            ScanKeyframe(self._state.next_node, deskewed, T_world_middle, T_world_body, covariance)
        )
        self._state.doubtful = self._state.last = None
        self._state.tree.clear()
        self._state.next_node += 1
        return self._state.keyframes[0].node
