"""Scan by scan against a map of those before, by any method that can place one."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from mapper.config.scan_odometry import ScanOdometryConfig
from mapper.deskew import STILL, Twist, twist_between
from mapper.features.scan_view import ScanView
from mapper.frames import Frame
from mapper.geometry import Transform, angle_between, inverse
from mapper.graph.model import BetweenFactor
from mapper.graph.noise import with_model_error
from mapper.odometry.base import Diagnostics, Track
from mapper.odometry.scan_to_map.matching import Matcher, Sweep
from mapper.odometry.scan_to_map.observation import ScanObservation, observe_scan
from mapper.registration.base import Aligner, Alignment
from mapper.registration.degeneracy import Degeneracy, degeneracy_of, loosened
from mapper.registration.gicp import measured
from mapper.timebase import NS_PER_S

_USUAL_OF = 20  # recent scans whose overlap tells what is usual


@dataclass(frozen=True, slots=True, eq=False)
class _Keyframe:
    """A scan that became a node."""

    node: int
    sweep: Sweep
    T_world_body: Transform


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """Where a scan was found, what the last keyframe says of it, and how."""

    T_world_body: Transform
    overlap: Alignment
    method: str


class ScanOdometry:
    """Predicts by constant velocity, asks the method, and holds its answer against the last keyframe.

    A scan is trusted by how much of it lies on the last keyframe's surfaces, compared with what was usual of
    late. One that overlaps less is sought farther away, then without any guess; what still does not fit is
    lost. Keyframes are the nodes, numbered from 0, each tied to the one before it by what their surfaces
    tell: motions that they leave open stay open in the factor.
    """

    def __init__(self, config: ScanOdometryConfig, make_matcher: Callable[[], Matcher]) -> None:
        self._config = config
        self._matcher = make_matcher()
        self._rescue = config.rescue.build() if config.rescue is not None else None
        self._rescuer: tuple[int, Aligner] | None = None
        self._overlaps: deque[float] = deque(maxlen=_USUAL_OF)
        self._keyframe: _Keyframe | None = None
        self._last_stamp_ns = 0
        self._last_world_body: Transform = np.eye(4)
        self._twist: Twist = STILL
        self._lost = 0
        self._next_node = 0

    def observe(self, frame: Frame) -> ScanObservation:
        """Return a frame's points in range, thinned. Pure.

        Raises:
            FrameError: Too few points are in range.
        """
        return observe_scan(frame, self._config)

    def track(self, observation: ScanObservation) -> Track:
        """Place the next observation, in time order."""
        stamp_ns, twist = observation.scan.stamp_ns, self._twist
        sweep = observation.as_swept(twist)
        keyframe = self._keyframe
        if keyframe is None:
            return self._start(sweep, np.eye(4), twist, method="start")
        elapsed_s = (stamp_ns - self._last_stamp_ns) / NS_PER_S
        placed = self._place(sweep, keyframe, self._last_world_body @ twist.over(elapsed_s))
        if placed is None:
            return self._lose(sweep, twist)
        self._lost = 0
        self._overlaps.append(placed.overlap.inlier_ratio)
        self._twist = twist_between(self._last_world_body, placed.T_world_body, duration_s=elapsed_s)
        return self._follow(sweep, keyframe, placed, twist)

    def view(self, observation: ScanObservation, twist: Twist | None = None, /) -> ScanView:
        """Return what a place is recognised by. Pure."""
        points = observation.as_swept(twist or STILL).prepared.points
        return ScanView(observation.scan.stamp_ns, points.astype(np.float32))

    def finish(self) -> Sequence[BetweenFactor]:
        """Return nothing: every measurement was final when its scan was tracked."""
        return ()

    def _place(self, sweep: Sweep, keyframe: _Keyframe, T_world_guess: Transform) -> _Placed | None:
        """Return the best place for a scan; None if none explains enough of it."""
        best = self._judged(
            sweep, keyframe, self._matcher.match(sweep, T_world_guess, reach="near"), method="map"
        )
        if self._overlaps_by(best) < self._config.usual_ratio:
            far = self._matcher.match(sweep, T_world_guess, reach="far")
            best = _better(best, self._judged(sweep, keyframe, far, method="far"))
        if self._overlaps_by(best) < self._config.usual_ratio and self._rescue is not None:
            found = self._aligner(keyframe).align(sweep.scan, np.eye(4))
            if found.converged:
                T_world_found = keyframe.T_world_body @ found.T_target_source
                near = self._matcher.match(sweep, T_world_found, reach="near")
                best = _better(best, self._judged(sweep, keyframe, near, method="rescued"))
        return best if self._overlaps_by(best) >= self._config.lost_ratio else None

    def _judged(
        self, sweep: Sweep, keyframe: _Keyframe, T_world_body: Transform | None, *, method: str
    ) -> _Placed | None:
        if T_world_body is None:
            return None
        overlap = measured(
            keyframe.sweep.prepared,
            sweep.prepared,
            inverse(keyframe.T_world_body) @ T_world_body,
            max_pair_distance_m=self._config.max_pair_distance_m,
        )
        return _Placed(T_world_body, overlap, method) if overlap.converged else None

    def _overlaps_by(self, placed: _Placed | None) -> float:
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

    def _follow(self, sweep: Sweep, keyframe: _Keyframe, placed: _Placed, twist: Twist) -> Track:
        """Hang a placed scan on the last keyframe, or make it the next one."""
        T_key_body = inverse(keyframe.T_world_body) @ placed.T_world_body
        known = placed.overlap.information
        assert known is not None  # overlaps that converged have it
        degeneracy = degeneracy_of(known, points=sweep.prepared.points)
        is_keyframe = (
            float(np.linalg.norm(T_key_body[:3, 3])) >= self._config.keyframe_distance_m
            or angle_between(np.eye(3), T_key_body[:3, :3]) >= self._config.keyframe_angle_rad
        )
        self._take(sweep, placed.T_world_body, is_keyframe=is_keyframe)
        node = keyframe.node
        factors: tuple[BetweenFactor, ...] = ()
        if is_keyframe:
            node = self._become_keyframe(sweep, placed.T_world_body)
            information = with_model_error(loosened(known, degeneracy), T_key_body)
            factors = (BetweenFactor(keyframe.node, node, T_key_body, information),)
        return Track(
            stamp_ns=sweep.scan.stamp_ns,
            node=node,
            T_node_body=np.eye(4) if is_keyframe else T_key_body,
            T_world_body=placed.T_world_body,
            is_keyframe=is_keyframe,
            diagnostics=_diagnostics(sweep, placed.overlap, placed.method, degeneracy),
            factors=factors,
            links=factors,
            twist=twist,
        )

    def _start(self, sweep: Sweep, T_world_body: Transform, twist: Twist, *, method: str) -> Track:
        """Make a scan the first keyframe of a map; nothing says where it lies to earlier maps."""
        self._matcher.clear()
        self._overlaps.clear()
        self._twist, self._lost = STILL, 0
        self._take(sweep, T_world_body, is_keyframe=True)
        node = self._become_keyframe(sweep, T_world_body)
        points = len(sweep.prepared.points)
        return Track(
            stamp_ns=sweep.scan.stamp_ns,
            node=node,
            T_node_body=np.eye(4),
            T_world_body=T_world_body,
            is_keyframe=True,
            diagnostics=Diagnostics(points, 0, 0, 0.0, "m", method),
            twist=twist,
        )

    def _lose(self, sweep: Sweep, twist: Twist) -> Track:
        """Give the scan up, or begin a new map with it once enough in a row were lost."""
        self._lost += 1
        if 0 < self._config.max_lost_scans < self._lost:
            return self._start(sweep, self._last_world_body, twist, method="new sub-map")
        points = len(sweep.prepared.points)
        return Track(
            stamp_ns=sweep.scan.stamp_ns,
            node=None,
            T_node_body=np.eye(4),
            T_world_body=self._last_world_body,
            is_keyframe=False,
            diagnostics=Diagnostics(points, 0, 0, 0.0, "m", "lost"),
        )

    def _take(self, sweep: Sweep, T_world_body: Transform, *, is_keyframe: bool) -> None:
        self._matcher.add(sweep, T_world_body, is_keyframe=is_keyframe)
        self._last_stamp_ns, self._last_world_body = sweep.scan.stamp_ns, T_world_body

    def _become_keyframe(self, sweep: Sweep, T_world_body: Transform) -> int:
        self._keyframe = _Keyframe(self._next_node, sweep, T_world_body)
        self._next_node += 1
        return self._keyframe.node


def _better(one: _Placed | None, other: _Placed | None) -> _Placed | None:
    """Return which of two answers explains more of the scan, the first if they are alike."""
    if one is None or other is None:
        return one or other
    return other if other.overlap.inlier_ratio > one.overlap.inlier_ratio else one


def _diagnostics(sweep: Sweep, overlap: Alignment, method: str, degeneracy: Degeneracy) -> Diagnostics:
    points = len(sweep.prepared.points)
    return Diagnostics(
        features=points,
        matches=points,
        inliers=overlap.pairs,
        residual=overlap.inlier_rmse_m,
        residual_unit="m",
        method=method,
        unseen=degeneracy.text,
    )
