"""Scan by scan against a map of those before, by any method that can place one."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from mapper.core.deskew import STILL, Twist, twist_between
from mapper.core.frames import Frame
from mapper.core.geometry import Transform, angle_between, inverse
from mapper.core.timebase import NS_PER_S
from mapper.features.scan_view import ScanView
from mapper.graph.model import BetweenFactor
from mapper.graph.noise import with_model_error
from mapper.odometry.base import Diagnostics, FrameResult
from mapper.odometry.scan_to_map.config import ScanOdometryConfig
from mapper.odometry.scan_to_map.matching import Matcher, Sweep
from mapper.odometry.scan_to_map.observation import ScanObservation, observe_scan
from mapper.registration.base import Aligner, Alignment
from mapper.registration.degeneracy import degeneracy_of, projected
from mapper.registration.factory import build_registration
from mapper.registration.refining import measured
from mapper.sources.base import FrameRef

_USUAL_OF = 20  # recent scans whose overlap tells what is usual
_MIN_ELAPSED_S = 0.005  # over less, an error of millimetres would be a velocity


@dataclass(frozen=True, slots=True, eq=False)
class _Keyframe:
    """A scan that became a node.

    Attributes:
        node: Its number.
        sweep: The scan as taken all at once in the middle of its sweep.
        T_world_middle: (4, 4) pose of the body then.
        T_world_body: (4, 4) pose of the body at the scan's stamp.
    """

    node: int
    sweep: Sweep
    T_world_middle: Transform
    T_world_body: Transform


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """Where a scan was found in the middle of its sweep, what the last keyframe says of it, and how."""

    T_world_middle: Transform
    overlap: Alignment
    method: str


class ScanOdometry:
    """Predicts by constant velocity, asks the method, and holds its answer against the last keyframe.

    A scan is trusted by how much of it lies on the last keyframe's surfaces, compared with what was usual of
    late. One that overlaps less is sought farther away, then without any guess; what still does not fit is
    lost. Keyframes are the nodes, numbered from 0, each tied to the one before it by what their surfaces
    tell: motions that they leave open stay open in the factor.
    """

    def __init__(self, config: ScanOdometryConfig, matcher: Matcher) -> None:
        self._config = config
        self._matcher = matcher
        self._rescue = build_registration(config.rescue) if config.rescue is not None else None
        self._rescuer: tuple[int, Aligner] | None = None
        self._overlaps: deque[float] = deque(maxlen=_USUAL_OF)
        self._keyframe: _Keyframe | None = None
        self._first: ScanObservation | None = None
        self._last_time_ns = 0
        self._T_world_last: Transform = np.eye(4)
        self._twist: Twist = STILL
        self._lost = 0
        self._next_node = 0

    def read(self, entry: FrameRef) -> ScanObservation:
        """Observe a frame of a log, without its colours. Pure.

        Raises:
            FrameError: It cannot be read, or not be used.
        """
        return self.observe(entry.load(colour=False))

    def observe(self, frame: Frame) -> ScanObservation:
        """Return a frame's points in range, thinned. Pure.

        Raises:
            FrameError: Too few points are in range.
        """
        return observe_scan(frame, self._config)

    def track(self, observation: ScanObservation) -> FrameResult:
        """Place the next observation, in time order."""
        if self._keyframe is None:
            return self._start(observation, np.eye(4), method="start")
        time_ns = _time_ns(observation)
        elapsed_s = (time_ns - self._last_time_ns) / NS_PER_S
        sweep = observation.as_swept(self._twist)
        placed = self._place(sweep, self._keyframe, self._T_world_last @ self._twist.over(elapsed_s))
        if placed is not None and self._first is not None and self._first.scan.times_s is not None:
            self._twist = self._twist_to(placed.T_world_middle, elapsed_s)
            sweep, placed = self._begin_again(self._first, observation, elapsed_s)
        if placed is None:
            return self._lose(observation)
        self._first, self._lost = None, 0
        self._overlaps.append(placed.overlap.inlier_ratio)
        self._twist = self._twist_to(placed.T_world_middle, elapsed_s)
        return self._follow(observation, sweep, placed)

    def view(self, observation: ScanObservation, twist: Twist | None = None, /) -> ScanView:
        """Return what a place is recognised by. Pure."""
        return observation.view(twist)

    def matches(self) -> None:
        """Return nothing: no features hold the pose."""

    def finish(self) -> Sequence[BetweenFactor]:
        """Return nothing: every measurement was final when its scan was tracked."""
        return ()

    def _begin_again(
        self, first: ScanObservation, second: ScanObservation, elapsed_s: float
    ) -> tuple[Sweep, _Placed | None]:
        """Place a map's first two scans anew, now that the motion during their sweeps is known."""
        assert self._keyframe is not None
        self._matcher.clear()
        self._rescuer = None
        self._next_node = self._keyframe.node
        T_world_middle = self._keyframe.T_world_body @ self._twist.over(first.middle_s)
        self._take_keyframe(first, first.as_swept(self._twist), T_world_middle)
        sweep = second.as_swept(self._twist)
        return sweep, self._place(sweep, self._keyframe, self._T_world_last @ self._twist.over(elapsed_s))

    def _twist_to(self, T_world_middle: Transform, elapsed_s: float) -> Twist:
        """Return the velocity since the last scan; that of before where sweeps overlap and no time passed."""
        if elapsed_s < _MIN_ELAPSED_S:
            return self._twist
        return twist_between(self._T_world_last, T_world_middle, duration_s=elapsed_s)

    def _place(self, sweep: Sweep, keyframe: _Keyframe, T_world_guess: Transform) -> _Placed | None:
        """Return the best place for a scan; None if none explains enough of it."""
        near = self._matcher.match(sweep, T_world_guess, reach="near")
        best = self._judged(sweep, keyframe, near, method="map")
        if self._share_of_usual(best) < self._config.usual_ratio:
            far = self._matcher.match(sweep, T_world_guess, reach="far")
            best = _better(best, self._judged(sweep, keyframe, far, method="far"))
        if self._share_of_usual(best) < self._config.usual_ratio and self._rescue is not None:
            found = self._aligner(keyframe).align(sweep.scan, np.eye(4))
            if found.converged:
                T_world_found = keyframe.T_world_middle @ found.T_target_source
                near = self._matcher.match(sweep, T_world_found, reach="near")
                best = _better(best, self._judged(sweep, keyframe, near, method="rescued"))
        return best if self._share_of_usual(best) >= self._config.lost_ratio else None

    def _judged(
        self, sweep: Sweep, keyframe: _Keyframe, T_world_middle: Transform | None, *, method: str
    ) -> _Placed | None:
        if T_world_middle is None:
            return None
        overlap = measured(
            keyframe.sweep.prepared,
            sweep.prepared,
            inverse(keyframe.T_world_middle) @ T_world_middle,
            max_pair_distance_m=self._config.max_pair_distance_m,
        )
        return _Placed(T_world_middle, overlap, method) if overlap.converged else None

    def _share_of_usual(self, placed: _Placed | None) -> float:
        """Return a scan's overlap as a share of what is usual; of all of it while nothing is usual yet."""
        if placed is None:
            return 0.0
        return placed.overlap.inlier_ratio / (median(self._overlaps) if self._overlaps else 1.0)

    def _aligner(self, keyframe: _Keyframe) -> Aligner:
        """Return the rescue bound to a keyframe, which is prepared once."""
        assert self._rescue is not None
        if self._rescuer is None or self._rescuer[0] != keyframe.node:
            self._rescuer = keyframe.node, self._rescue.prepare(keyframe.sweep.scan)
        return self._rescuer[1]

    def _follow(self, observation: ScanObservation, sweep: Sweep, placed: _Placed) -> FrameResult:
        """Hang a placed scan on the last keyframe, or make it the next one."""
        keyframe, overlap = self._keyframe, placed.overlap
        assert keyframe is not None
        assert overlap.information is not None  # overlaps that converged have it
        T_world_body = placed.T_world_middle @ self._twist.over(-observation.middle_s)
        T_key_body = inverse(keyframe.T_world_body) @ T_world_body
        degeneracy = degeneracy_of(overlap.information, points=sweep.prepared.points)
        is_keyframe = (
            float(np.linalg.norm(T_key_body[:3, 3])) >= self._config.keyframe_distance_m
            or angle_between(np.eye(3), T_key_body[:3, :3]) >= self._config.keyframe_angle_rad
        )
        node = keyframe.node
        factors: tuple[BetweenFactor, ...] = ()
        if is_keyframe:
            node = self._take_keyframe(observation, sweep, placed.T_world_middle)
            information = with_model_error(projected(overlap.information, degeneracy), T_key_body)
            factors = (BetweenFactor(keyframe.node, node, T_key_body, information),)
        else:
            self._take(observation, sweep, placed.T_world_middle, is_keyframe=False)
        points = len(sweep.prepared.points)
        return FrameResult(
            stamp_ns=observation.scan.stamp_ns,
            node=node,
            T_node_body=np.eye(4) if is_keyframe else T_key_body,
            T_world_body=T_world_body,
            is_keyframe=is_keyframe,
            diagnostics=Diagnostics(
                features=points,
                matches=points,
                inliers=overlap.pairs,
                residual=overlap.inlier_rmse_m,
                residual_unit="m",
                method=placed.method,
                unseen=degeneracy.text,
            ),
            factors=factors,
            links=factors,
            twist=self._twist,
        )

    def _start(self, observation: ScanObservation, T_world_body: Transform, *, method: str) -> FrameResult:
        """Make a scan the first keyframe of a map; nothing says where it lies to earlier maps."""
        self._matcher.clear()
        self._overlaps.clear()
        self._twist, self._lost, self._first = STILL, 0, observation
        sweep = observation.as_swept(STILL)
        node = self._take_keyframe(observation, sweep, T_world_body)
        return FrameResult(
            stamp_ns=observation.scan.stamp_ns,
            node=node,
            T_node_body=np.eye(4),
            T_world_body=T_world_body,
            is_keyframe=True,
            diagnostics=Diagnostics(len(sweep.prepared.points), 0, 0, 0.0, "m", method),
            is_sharp=observation.scan.times_s is None,
        )

    def _lose(self, observation: ScanObservation) -> FrameResult:
        """Give the scan up, or begin a new map with it once enough in a row were lost."""
        self._lost += 1
        if 0 < self._config.max_lost_scans < self._lost:
            return self._start(observation, self._T_world_last, method="new sub-map")
        return FrameResult(
            stamp_ns=observation.scan.stamp_ns,
            node=None,
            T_node_body=np.eye(4),
            T_world_body=self._T_world_last,
            is_keyframe=False,
            diagnostics=Diagnostics(len(observation.scan.points_body), 0, 0, 0.0, "m", "lost"),
        )

    def _take_keyframe(self, observation: ScanObservation, sweep: Sweep, T_world_middle: Transform) -> int:
        self._take(observation, sweep, T_world_middle, is_keyframe=True)
        T_world_body = T_world_middle @ self._twist.over(-observation.middle_s)
        self._keyframe = _Keyframe(self._next_node, sweep, T_world_middle, T_world_body)
        self._next_node += 1
        return self._keyframe.node

    def _take(
        self, observation: ScanObservation, sweep: Sweep, T_world_middle: Transform, *, is_keyframe: bool
    ) -> None:
        self._matcher.add(sweep, T_world_middle, is_keyframe=is_keyframe)
        self._last_time_ns, self._T_world_last = _time_ns(observation), T_world_middle


def _time_ns(observation: ScanObservation) -> int:
    """Return the middle of a scan's sweep."""
    return observation.scan.stamp_ns + round(observation.middle_s * NS_PER_S)


def _better(one: _Placed | None, other: _Placed | None) -> _Placed | None:
    """Return which of two answers explains more of the scan, the first if they are alike."""
    if one is None or other is None:
        return one or other
    return other if other.overlap.inlier_ratio > one.overlap.inlier_ratio else one
