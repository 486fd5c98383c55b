"""Scan-to-map odometry by any scan matcher, with checks of each pose against the last keyframe."""

from collections import deque
from dataclasses import replace

import numpy as np

from mapper.core.deskew import STILL, Motion
from mapper.core.doubts import Doubt
from mapper.core.frames import Frame
from mapper.core.geometry import Array, Transform, adjoint, inverse
from mapper.core.trajectory import Trajectory
from mapper.features.frame_view import ScanView
from mapper.graph.config import WheelNoiseConfig
from mapper.graph.measurement_covariance import information_of
from mapper.graph.model import BetweenFactor
from mapper.odometry.base import Diagnostics, FrameOdometry, FrameResult, lost_frame
from mapper.odometry.keyframe_distance import is_far
from mapper.odometry.motion_prior import MotionPrior, WithMotionPrior
from mapper.odometry.scans.config import ScanOdometryConfig
from mapper.odometry.scans.motion_model import MotionModel
from mapper.odometry.scans.pose_assessment import PoseAssessment
from mapper.odometry.scans.pose_search import KnownPath, PoseSearch
from mapper.odometry.scans.scan_fit import ScanKeyframe
from mapper.odometry.scans.scan_matcher import DeskewedScan, ScanMatcher
from mapper.odometry.scans.scan_noise import PoseNoise, ScanNoise
from mapper.odometry.scans.scan_observation import ScanObservation, observe_scan
from mapper.odometry.scans.sweep_registration import PlacedScan, SweepRegistration
from mapper.sensing.gyroscope import Gyroscope

_KEYFRAMES = 5  # the last ones, with which a scan is compared
MOST_LOST_SCANS = 10
"""Lost scans in a row after which a new map begins."""
_DISPLACED = 0.5
"""Displacement of a sweep's outer points, in voxels, from which on its pose is doubtful."""


class ScanOdometry(WithMotionPrior, FrameOdometry[ScanObservation]):
    """Odometry by constant-velocity prediction, a scan matcher, and acceptance by this log's medians.

    A pose is compared with the last keyframes and the last scan: the share of the points that have a partner
    there, the share that agrees in the direction where the least does, the points in space that rays passed,
    and the jump from the predicted pose. Where these differ from the log's medians, other hypotheses are
    tried; a pose that still differs is doubtful, and where next to nothing agrees, lost. A scan of which the
    keyframe shows little is the next keyframe. A doubtful scan does not enter the map; if it is far, it is a
    keyframe with an inflated covariance, from which tracking goes on once another scan fits it and not the
    keyframe before.
    Keyframes are the nodes, numbered from 0, each with a factor to an earlier one. Motions that the surfaces
    do not show are predicted, with a covariance that grows until they are seen again.
    """

    def __init__(
        self,
        config: ScanOdometryConfig,
        matcher: ScanMatcher,
        gyroscope: Gyroscope | None = None,
        wheels: Trajectory | None = None,
        wheel_noise: WheelNoiseConfig | None = None,
    ) -> None:
        """Begin before the first scan.

        Args:
            config: Settings.
            matcher: Finds poses in the local map.
            gyroscope: Angular velocities of the log; None if it has none.
            wheels: T_odom_body by which the motion is predicted; None if it is not.
            wheel_noise: Errors of most wheels; None is those of the defaults.
        """
        self._config = config
        self._matcher = matcher
        self._assessment = PoseAssessment(config)
        self._registration = SweepRegistration(config, matcher, PoseSearch(config, matcher, self._assessment))
        self._prior = MotionPrior(gyroscope, wheels, wheel_noise)
        self._noise = ScanNoise(self._prior.wheel_noise)
        self._motion = MotionModel(0, np.eye(4), self._prior)
        self._keyframes: deque[ScanKeyframe] = deque(maxlen=_KEYFRAMES)  # the newest first
        self._doubtful: ScanKeyframe | None = None
        self._last: ScanKeyframe | None = None
        self._is_last_sure = True
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
        """Track the next scan, in time order: predict, deskew, register, assess, update."""
        if not self._keyframes:
            return self._start(observation, np.eye(4), method="start")
        placed = self._registration.register(observation, self._path)
        if placed is not None and self._first is not None and self._first.scan.times_s is not None:
            placed = self._begin_again(self._first, observation, placed.found.T_world_middle)
        if placed is None:
            return self._not_found(observation)
        self._first, self._lost_scans = None, 0
        noise = self._noise_of(observation, placed)
        doubts = (*self._assessment.doubts(placed.found), *self._sweep_doubts(observation, placed))
        covariance = noise.inflated(placed.found.jump) if doubts else noise.covariance
        if not doubts and placed.found.keyframe is self._doubtful:
            self._go_on_from(self._doubtful)
        self._follow(observation, placed, is_doubtful=bool(doubts))
        result = self._insert(observation, placed, covariance, is_doubtful=bool(doubts))
        return replace(result, doubts=(*doubts, *noise.doubts))

    def view(self, observation: ScanObservation, twist: Motion | None = None, /) -> ScanView:
        """Return the view for place recognition. Pure."""
        return observation.view(twist)

    def matches(self) -> None:
        """Return None: the pose is not from features."""

    @property
    def _path(self) -> KnownPath:
        return KnownPath(self._keyframes, self._doubtful, self._last, self._is_last_sure, self._motion)

    def _noise_of(self, observation: ScanObservation, placed: PlacedScan) -> PoseNoise:
        """Return the noise of a scan's pose relative to the keyframe that it was compared with."""
        found = placed.found
        T_key_scan = inverse(found.keyframe.T_world_middle) @ found.T_world_middle
        at_stamp = observation.middle_s**2 * placed.velocity_covariance
        Ad = adjoint(inverse(T_key_scan))
        return self._noise.of(
            found.fit,
            found.open_m,
            T_key_scan,
            self._motion.elapsed_s(observation.middle_ns),
            at_stamp + Ad @ found.keyframe.covariance_at_stamp @ Ad.T,
            is_by_wheels=self._motion.is_by_wheels(observation.middle_ns),
        )

    def _go_on_from(self, keyframe: ScanKeyframe) -> None:
        """Make a keyframe that was in doubt the whole map, as another scan fits it and not those before."""
        self._matcher.clear()
        self._matcher.add(keyframe.deskewed, keyframe.T_world_middle, is_keyframe=True)
        self._keyframes.clear()
        self._keyframes.appendleft(keyframe)

    def _follow(self, observation: ScanObservation, placed: PlacedScan, *, is_doubtful: bool) -> None:
        """Let the motion follow a scan's pose."""
        self._motion.follow(
            observation.middle_ns,
            placed.found.T_world_middle,
            is_certain=not is_doubtful and placed.found.is_measured,
            measured=None if placed.twist is None else (placed.twist, placed.velocity_covariance),
        )

    def _insert(
        self, observation: ScanObservation, placed: PlacedScan, covariance: Array, *, is_doubtful: bool
    ) -> FrameResult:
        """Insert a scan into the map unless it is doubtful, as a keyframe if it is far; return its result."""
        found, deskewed = placed.found, placed.deskewed
        motion: Motion = self._motion.twist if placed.sweep is None else placed.sweep
        T_world_body = found.T_world_middle @ motion.over(-observation.middle_s)
        T_key_body = inverse(found.keyframe.T_world_body) @ T_world_body
        is_new = self._assessment.shows_less(found) and not is_doubtful
        is_keyframe = is_new or is_far(T_key_body, self._config)
        at_stamp = observation.middle_s**2 * placed.velocity_covariance
        scan = ScanKeyframe(self._next_node, deskewed, found.T_world_middle, T_world_body, at_stamp)
        if not is_doubtful:
            self._doubtful = None
            self._assessment.statistics.add(found.shares)
            self._matcher.add(deskewed, found.T_world_middle, is_keyframe=is_keyframe)
        node = found.keyframe.node
        factors: tuple[BetweenFactor, ...] = ()
        if is_keyframe:
            node = self._next_node
            self._next_node += 1
            self._noise.restart()
            factors = (BetweenFactor(found.keyframe.node, node, T_key_body, information_of(covariance)),)
            if is_doubtful:
                self._doubtful = scan
            else:
                self._keyframes.appendleft(scan)
        self._last, self._is_last_sure = scan, not is_doubtful
        return FrameResult(
            stamp_ns=observation.scan.stamp_ns,
            node=node,
            T_node_body=np.eye(4) if is_keyframe else T_key_body,
            T_world_body=T_world_body,
            is_keyframe=is_keyframe,
            diagnostics=found.diagnostics(points=len(deskewed.prepared.points)),
            factors=factors,
            links=factors,
            twist=motion.about(-observation.middle_s),
            covariance=covariance,
        )

    def _sweep_doubts(self, observation: ScanObservation, placed: PlacedScan) -> tuple[Doubt, ...]:
        """Return that the points of a sweep may be displaced, if they may."""
        turning = float(np.sqrt(np.linalg.eigvalsh(placed.velocity_covariance[:3, :3])[-1]))
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

    def _begin_again(
        self, first: ScanObservation, second: ScanObservation, T_world_second: Transform
    ) -> PlacedScan | None:
        """Track a map's first two scans again, now that the motion during their sweeps is known."""
        twist = self._motion.mean_twist(second.middle_ns, T_world_second)
        self._matcher.clear()
        self._next_node = self._keyframes[0].node
        T_world_middle = self._keyframes[0].T_world_body @ twist.over(first.middle_s)
        self._motion = MotionModel(first.middle_ns, T_world_middle, self._prior)
        self._motion.twist = twist
        self._add_keyframe(first, first.deskew(twist), T_world_middle)
        return self._registration.register(second, self._path)

    def _start(self, observation: ScanObservation, T_world_body: Transform, *, method: str) -> FrameResult:
        """Make a scan the first keyframe of a map, unconnected to earlier maps."""
        self._matcher.clear()
        self._assessment.statistics.clear()
        self._noise.restart()
        self._lost_scans, self._first = 0, observation
        deskewed = observation.deskew(STILL)
        self._motion = MotionModel(observation.middle_ns, T_world_body, self._prior)
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
        if self._lost_scans > MOST_LOST_SCANS:
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
