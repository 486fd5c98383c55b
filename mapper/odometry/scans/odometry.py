"""Scan-to-map odometry by any scan matcher, with checks of each pose against the last keyframe."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from mapper.core.deskew import STILL, Twist
from mapper.core.doubts import Doubt
from mapper.core.frames import Frame
from mapper.core.geometry import Array, Transform, adjoint, inverse
from mapper.core.timebase import NS_PER_S
from mapper.features.frame_view import ScanView
from mapper.graph.model import BetweenFactor
from mapper.odometry.base import Diagnostics, FrameOdometry, FrameResult, lost_frame
from mapper.odometry.keyframe_distance import is_far
from mapper.odometry.scans.config import ScanOdometryConfig
from mapper.odometry.scans.motion_model import MotionModel
from mapper.odometry.scans.pose_search import PoseCandidate, PoseSearch
from mapper.odometry.scans.scan_fit import ScanKeyframe
from mapper.odometry.scans.scan_matcher import DeskewedScan, ScanMatcher
from mapper.odometry.scans.scan_noise import ScanNoise
from mapper.odometry.scans.scan_observation import ScanObservation, observe_scan
from mapper.odometry.scans.sweep_motion import SweepMotion, sweep_motion

_KEYFRAMES = 5  # so many last ones are compared with
_NEGLIGIBLE, _SETTLED, _DISPLACED = 0.2, 0.05, 0.5
"""Displacement of a sweep's outer points, in voxels, by a change of the velocity: less is not looked for,
less ends the search for the velocity, more makes a pose doubtful."""
_ROUNDS = 3
_WIDENED = 2.0  # expected changes of the velocity, for turns begin and end suddenly
_CHANGED = 0.25  # of what the velocity may change, where it is not measured


class ScanOdometry(FrameOdometry[ScanObservation]):
    """Odometry by constant-velocity prediction, a scan matcher, and acceptance by what is usual in this log.

    A pose is compared with the last keyframe: the share of the points that have a partner there, the share
    that agrees in the direction where the least does, the points in space that rays passed, and the jump from
    the predicted pose. What is unusual is searched by other ways; what stays so is doubtful, and where next
    to nothing agrees, lost. A doubtful scan does not enter the map; if it is far, it is a keyframe with an
    inflated covariance, from which tracking goes on once another scan fits it and not the keyframe before.
    Keyframes are the nodes, numbered from 0, each with a factor to an earlier one. Motions that the surfaces
    do not show are predicted, with a covariance that grows until they are seen again.
    """

    def __init__(self, config: ScanOdometryConfig, matcher: ScanMatcher) -> None:
        self._config = config
        self._matcher = matcher
        self._search = PoseSearch(config, matcher)
        self._noise = ScanNoise()
        self._motion = MotionModel(0, np.eye(4))
        self._keyframes: deque[ScanKeyframe] = deque(maxlen=_KEYFRAMES)  # the newest first
        self._doubtful: ScanKeyframe | None = None
        self._last: ScanKeyframe | None = None
        self._first: ScanObservation | None = None
        self._lost_scans = 0
        self._next_node = 0

    def observe(self, frame: Frame) -> ScanObservation:
        """Return a frame's points in range, thinned. Pure.

        Raises:
            FrameError: Too few points are in range.
        """
        return observe_scan(frame, self._config)

    def track(self, observation: ScanObservation) -> FrameResult:
        """Track the next frame, in time order."""
        if not self._keyframes:
            return self._start(observation, np.eye(4), method="start")
        placed = self._place(observation)
        if placed is not None and self._first is not None and self._first.scan.times_s is not None:
            placed = self._begin_again(self._first, observation, placed.found.T_world_middle)
        if placed is None:
            return self._not_found(observation)
        self._first, self._lost_scans = None, 0
        return self._placed(observation, placed)

    def view(self, observation: ScanObservation, twist: Twist | None = None, /) -> ScanView:
        """Return the view for place recognition. Pure."""
        return observation.view(twist)

    def matches(self) -> None:
        """Return None: the pose is not from features."""

    def _place(self, observation: ScanObservation) -> "_PlacedScan | None":
        """Return where a scan fits best; None if next to nothing agrees with any pose.

        Where the velocity may have changed so much that it displaces the points of the sweep, it is found
        together with the pose; not before the errors of a few predictions are known, as two scans, each with
        a velocity of its own, fit under wrong ones, too.
        """
        motion, time_ns = self._motion, _time_ns(observation)
        deskewed, sigmas = observation.deskew(motion.twist), motion.velocity_sigmas(time_ns)
        if motion.spread(time_ns) is None or observation.displacement(float(sigmas[0])) <= _NEGLIGIBLE:
            found = self._find_pose(deskewed, time_ns)
            if found is None:
                return None
            return _PlacedScan(deskewed, found, None, np.diag((_CHANGED * sigmas) ** 2))
        T_world_predicted = motion.predicted(time_ns)
        matched = self._matcher.match(deskewed, T_world_predicted, reach="near")
        T_world_middle = T_world_predicted if matched is None else matched
        found = None
        sweep: SweepMotion | None = None
        sweep_of_middle, settled = observation.sweep(observation.middle_s), np.zeros(3)
        for _ in range(_ROUNDS):
            expected, covariance = motion.velocity(time_ns, T_world_middle)
            before = motion.twist if sweep is None else sweep.twist
            measured = sweep_motion(
                self._keyframes,
                sweep_of_middle,
                T_world_middle,
                expected,
                _WIDENED**2 * covariance,
                start=before,
                max_pair_distance_m=self._config.max_pair_distance_m,
            )
            if measured is None and found is not None:
                break
            if measured is not None:
                sweep, deskewed = measured, observation.deskew(measured.twist)
                settled = measured.twist.rotation_radps - before.rotation_radps
            found = self._find_pose(deskewed, time_ns, None if measured is None else measured.T_world_middle)
            if found is None:
                break
            T_world_middle = found.T_world_middle
            if measured is not None and observation.displacement(float(np.linalg.norm(settled))) < _SETTLED:
                break
        if found is None:
            deskewed, sweep = observation.deskew(motion.twist), None
            found = self._find_pose(deskewed, time_ns)
        if found is None:
            return None
        covariance = motion.velocity(time_ns, found.T_world_middle)[1]
        if sweep is not None:
            accelerated = motion.acceleration(time_ns, found.T_world_middle, sweep.twist)
            bent = accelerated * observation.half_s / 3.0
            covariance = sweep.covariance + np.diag([*(settled**2 + bent**2), 0.0, 0.0, 0.0])
        return _PlacedScan(deskewed, found, None if sweep is None else sweep.twist, covariance)

    def _find_pose(
        self, deskewed: DeskewedScan, time_ns: int, T_world_guess: Transform | None = None
    ) -> PoseCandidate | None:
        """Return the pose that fits best; None if next to nothing agrees with any."""
        found = self._search.find(
            deskewed, self._keyframes, self._doubtful, self._last, self._motion, time_ns, T_world_guess
        )
        return None if found is None or self._search.is_lost(found) else found

    def _begin_again(
        self, first: ScanObservation, second: ScanObservation, T_world_second: Transform
    ) -> "_PlacedScan | None":
        """Track a map's first two scans again, now that the motion during their sweeps is known."""
        twist = self._motion.mean_twist(_time_ns(second), T_world_second)
        self._matcher.clear()
        self._next_node = self._keyframes[0].node
        T_world_middle = self._keyframes[0].T_world_body @ twist.over(first.middle_s)
        self._motion = MotionModel(_time_ns(first), T_world_middle)
        self._motion.twist = twist
        self._add_keyframe(first, first.deskew(twist), T_world_middle)
        return self._place(second)

    def _placed(self, observation: ScanObservation, placed: "_PlacedScan") -> FrameResult:
        """Return the result of a scan whose pose was found, and make it a keyframe if it is far."""
        found, deskewed = placed.found, placed.deskewed
        time_ns, keyframe = _time_ns(observation), found.keyframe
        T_key_scan = inverse(keyframe.T_world_middle) @ found.T_world_middle
        at_stamp = observation.middle_s**2 * placed.velocity_covariance
        Ad = adjoint(inverse(T_key_scan))
        noise = self._noise.of(
            found.fit,
            found.open_m,
            T_key_scan,
            self._motion.elapsed_s(time_ns),
            at_stamp + Ad @ keyframe.covariance_at_stamp @ Ad.T,
        )
        doubts = (*self._search.doubts(found), *self._sweep_doubts(observation, placed.velocity_covariance))
        fits = not doubts
        covariance = noise.covariance if fits else noise.inflated(found.jump)
        if fits and keyframe is self._doubtful:
            self._matcher.clear()
            self._matcher.add(keyframe.deskewed, keyframe.T_world_middle, is_keyframe=True)
            self._keyframes.clear()
            self._keyframes.appendleft(keyframe)
        self._motion.follow(
            time_ns,
            found.T_world_middle,
            is_certain=fits and found.is_measured,
            measured=None if placed.twist is None else (placed.twist, placed.velocity_covariance),
        )
        T_world_body = found.T_world_middle @ self._motion.twist.over(-observation.middle_s)
        T_key_body = inverse(keyframe.T_world_body) @ T_world_body
        is_keyframe = is_far(T_key_body, self._config)
        node = keyframe.node
        factors: tuple[BetweenFactor, ...] = ()
        scan = ScanKeyframe(self._next_node, deskewed, found.T_world_middle, T_world_body, at_stamp)
        if fits:
            self._doubtful = None
            self._search.usual.add(found.shares)
            self._matcher.add(deskewed, found.T_world_middle, is_keyframe=is_keyframe)
        if is_keyframe:
            node = self._next_node
            self._next_node += 1
            self._noise.restart()
            information = np.linalg.inv(covariance)
            factors = (BetweenFactor(keyframe.node, node, T_key_body, 0.5 * (information + information.T)),)
            if fits:
                self._keyframes.appendleft(scan)
            else:
                self._doubtful = scan
        self._last = scan
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
            twist=self._motion.twist,
            doubts=(*doubts, *noise.doubts),
            covariance=covariance,
        )

    def _sweep_doubts(self, observation: ScanObservation, velocity_covariance: Array) -> tuple[Doubt, ...]:
        """Return that the points of a sweep may be displaced, if they may."""
        turning = float(np.sqrt(np.linalg.eigvalsh(velocity_covariance[:3, :3])[-1]))
        voxels = observation.displacement(turning)
        if self._config.usual_ratio == 0.0 or voxels <= _DISPLACED:
            return ()
        return (
            Doubt(
                "unobservable",
                f"its points may be displaced by {voxels * observation.voxel_m:.2f} m: the sensor turned "
                f"during its sweep of {2.0 * observation.half_s:.2g} s, "
                f"known to {np.degrees(turning):.0f}° a second",
            ),
        )

    def _start(self, observation: ScanObservation, T_world_body: Transform, *, method: str) -> FrameResult:
        """Make a scan the first keyframe of a map, unconnected to earlier maps."""
        self._matcher.clear()
        self._search.usual.clear()
        self._noise.restart()
        self._lost_scans, self._first = 0, observation
        deskewed = observation.deskew(STILL)
        self._motion = MotionModel(_time_ns(observation), T_world_body)
        node = self._add_keyframe(observation, deskewed, T_world_body)
        return FrameResult(
            stamp_ns=observation.scan.stamp_ns,
            node=node,
            T_node_body=np.eye(4),
            T_world_body=T_world_body,
            is_keyframe=True,
            diagnostics=Diagnostics(len(deskewed.prepared.points), 0, 0, 0.0, "m", method),
            is_sharp=observation.scan.times_s is None,
        )

    def _not_found(self, observation: ScanObservation) -> FrameResult:
        """Return a lost scan, or begin a new map with it once enough in a row were lost."""
        self._lost_scans += 1
        if 0 < self._config.max_lost_scans < self._lost_scans:
            return self._start(observation, self._motion.T_world_last, method="new sub-map")
        scan = observation.scan
        return lost_frame(scan.stamp_ns, self._motion.T_world_last, features=len(scan.points_body))

    def _add_keyframe(
        self, observation: ScanObservation, deskewed: DeskewedScan, T_world_middle: Transform
    ) -> int:
        """Make a scan a keyframe without a factor; return its node."""
        self._matcher.add(deskewed, T_world_middle, is_keyframe=True)
        twist = self._motion.twist
        T_world_body = T_world_middle @ twist.over(-observation.middle_s)
        turn_rad = observation.middle_s * float(np.linalg.norm(twist.rotation_radps))
        covariance = np.diag([turn_rad**2] * 3 + [0.0] * 3)  # it may just have begun to turn
        self._keyframes.clear()
        self._keyframes.append(
            ScanKeyframe(self._next_node, deskewed, T_world_middle, T_world_body, covariance)
        )
        self._doubtful = self._last = None
        self._next_node += 1
        return self._keyframes[0].node


@dataclass(frozen=True, slots=True, eq=False)
class _PlacedScan:
    """A scan with its pose.

    Attributes:
        deskewed: The scan.
        found: Its pose in the middle of the sweep.
        twist: Velocity then, if it was measured; None is the mean one since the scan before.
        velocity_covariance: (6, 6) of the velocity, (rad/s)² and (m/s)².
    """

    deskewed: DeskewedScan
    found: PoseCandidate
    twist: Twist | None
    velocity_covariance: Array


def _time_ns(observation: ScanObservation) -> int:
    """Return the middle of a scan's sweep."""
    return observation.scan.stamp_ns + round(observation.middle_s * NS_PER_S)
