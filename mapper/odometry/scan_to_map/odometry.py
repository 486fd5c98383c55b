"""Scan-to-map odometry by any scan matcher, with checks of each pose against the last keyframe."""

from collections import deque
from dataclasses import dataclass
from statistics import median

import numpy as np

from mapper.core.deskew import STILL, Twist, twist_between
from mapper.core.frames import Frame
from mapper.core.geometry import Transform, inverse
from mapper.core.timebase import NS_PER_S
from mapper.features.frame_view import ScanView
from mapper.graph.model import BetweenFactor
from mapper.graph.noise import with_model_error
from mapper.odometry.base import Diagnostics, FrameOdometry, FrameResult, lost_frame
from mapper.odometry.keyframe_distance import is_far
from mapper.odometry.scan_to_map.config import ScanOdometryConfig
from mapper.odometry.scan_to_map.scan_matcher import DeskewedScan, ScanMatcher
from mapper.odometry.scan_to_map.scan_observation import ScanObservation, observe_scan
from mapper.registration.base import Aligner, Alignment
from mapper.registration.degeneracy import degeneracy_of, projected
from mapper.registration.factory import build_registration
from mapper.registration.refining import measured

_USUAL_OF = 20  # recent scans of whose overlaps the median is usual
_MIN_ELAPSED_S = 0.005  # over less, an error of millimetres becomes a large velocity


@dataclass(frozen=True, slots=True, eq=False)
class _Keyframe:
    """A scan that became a node.

    Attributes:
        node: Its number.
        deskewed: The scan as taken all at once in the middle of its sweep.
        T_world_middle: (4, 4) pose of the body then.
        T_world_body: (4, 4) pose of the body at the scan's stamp.
    """

    node: int
    deskewed: DeskewedScan
    T_world_middle: Transform
    T_world_body: Transform


@dataclass(frozen=True, slots=True, eq=False)
class _PoseCandidate:
    """Pose of the body in the middle of a scan's sweep, the overlap with the last keyframe, and the step."""

    T_world_middle: Transform
    overlap: Alignment
    method: str


class ScanOdometry(FrameOdometry[ScanObservation]):
    """Odometry by constant-velocity prediction, a scan matcher, and acceptance by overlap.

    A pose is accepted by the share of the scan that lies on the last keyframe's surfaces, relative to the
    median of recent scans. With less overlap the scan is searched in a larger range, then without a guess;
    if the overlap is still too small it is lost. Keyframes are the nodes, numbered from 0, each with a factor
    to the one before it from their overlap; motions that the surfaces leave unobservable stay so in the
    factor.
    """

    def __init__(self, config: ScanOdometryConfig, matcher: ScanMatcher) -> None:
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
        if self._keyframe is None:
            return self._start(observation, np.eye(4), method="start")
        time_ns = _time_ns(observation)
        elapsed_s = (time_ns - self._last_time_ns) / NS_PER_S
        deskewed = observation.deskew(self._twist)
        found = self._find_pose(deskewed, self._keyframe, self._T_world_last @ self._twist.over(elapsed_s))
        if found is not None and self._first is not None and self._first.scan.times_s is not None:
            self._twist = self._twist_to(found.T_world_middle, elapsed_s)
            deskewed, found = self._begin_again(self._first, observation, elapsed_s)
        if found is None:
            return self._not_found(observation)
        self._first, self._lost_scans = None, 0
        self._overlaps.append(found.overlap.inlier_ratio)
        self._twist = self._twist_to(found.T_world_middle, elapsed_s)
        return self._tracked(observation, deskewed, found)

    def view(self, observation: ScanObservation, twist: Twist | None = None, /) -> ScanView:
        """Return the view for place recognition. Pure."""
        return observation.view(twist)

    def matches(self) -> None:
        """Return None: the pose is not from features."""

    def _begin_again(
        self, first: ScanObservation, second: ScanObservation, elapsed_s: float
    ) -> tuple[DeskewedScan, _PoseCandidate | None]:
        """Track a map's first two scans again, now that the motion during their sweeps is known."""
        assert self._keyframe is not None
        self._matcher.clear()
        self._rescuer = None
        self._next_node = self._keyframe.node
        T_world_middle = self._keyframe.T_world_body @ self._twist.over(first.middle_s)
        self._add_keyframe(first, first.deskew(self._twist), T_world_middle)
        deskewed, T_world_guess = second.deskew(self._twist), self._T_world_last @ self._twist.over(elapsed_s)
        return deskewed, self._find_pose(deskewed, self._keyframe, T_world_guess)

    def _twist_to(self, T_world_middle: Transform, elapsed_s: float) -> Twist:
        """Return the velocity since the last scan; the one before it if hardly any time passed."""
        if elapsed_s < _MIN_ELAPSED_S:
            return self._twist
        return twist_between(self._T_world_last, T_world_middle, duration_s=elapsed_s)

    def _find_pose(
        self, deskewed: DeskewedScan, keyframe: _Keyframe, T_world_guess: Transform
    ) -> _PoseCandidate | None:
        """Return the pose of most overlap; None if that is too small."""
        near = self._matcher.match(deskewed, T_world_guess, reach="near")
        best = self._assess(deskewed, keyframe, near, method="map")
        if self._share_of_usual(best) < self._config.usual_ratio:
            far = self._matcher.match(deskewed, T_world_guess, reach="far")
            best = _better(best, self._assess(deskewed, keyframe, far, method="far"))
        if self._share_of_usual(best) < self._config.usual_ratio and self._rescue is not None:
            found = self._aligner(keyframe).align(deskewed.scan, np.eye(4))
            if found.converged:
                T_world_found = keyframe.T_world_middle @ found.T_target_source
                near = self._matcher.match(deskewed, T_world_found, reach="near")
                best = _better(best, self._assess(deskewed, keyframe, near, method="rescued"))
        return best if self._share_of_usual(best) >= self._config.lost_ratio else None

    def _assess(
        self, deskewed: DeskewedScan, keyframe: _Keyframe, T_world_middle: Transform | None, *, method: str
    ) -> _PoseCandidate | None:
        """Return a pose with its overlap; None without a pose, or if the overlap is too small to measure."""
        if T_world_middle is None:
            return None
        overlap = measured(
            keyframe.deskewed.prepared,
            deskewed.prepared,
            inverse(keyframe.T_world_middle) @ T_world_middle,
            max_pair_distance_m=self._config.max_pair_distance_m,
        )
        return _PoseCandidate(T_world_middle, overlap, method) if overlap.converged else None

    def _share_of_usual(self, candidate: _PoseCandidate | None) -> float:
        """Return the overlap relative to the median of recent scans, or to the whole scan without any."""
        if candidate is None:
            return 0.0
        return candidate.overlap.inlier_ratio / (median(self._overlaps) if self._overlaps else 1.0)

    def _aligner(self, keyframe: _Keyframe) -> Aligner:
        """Return the rescue registration bound to a keyframe, which is prepared once."""
        assert self._rescue is not None
        if self._rescuer is None or self._rescuer[0] != keyframe.node:
            self._rescuer = keyframe.node, self._rescue.prepare(keyframe.deskewed.scan)
        return self._rescuer[1]

    def _tracked(
        self, observation: ScanObservation, deskewed: DeskewedScan, found: _PoseCandidate
    ) -> FrameResult:
        """Return the result of a scan whose pose was found, and make it a keyframe if it is far."""
        keyframe, overlap = self._keyframe, found.overlap
        assert keyframe is not None
        assert overlap.information is not None  # overlaps that converged have it
        T_world_body = found.T_world_middle @ self._twist.over(-observation.middle_s)
        T_key_body = inverse(keyframe.T_world_body) @ T_world_body
        degeneracy = degeneracy_of(overlap.information, points=deskewed.prepared.points)
        is_keyframe = is_far(
            T_key_body,
            distance_m=self._config.keyframe_distance_m,
            angle_rad=self._config.keyframe_angle_rad,
        )
        node = keyframe.node
        factors: tuple[BetweenFactor, ...] = ()
        if is_keyframe:
            node = self._add_keyframe(observation, deskewed, found.T_world_middle)
            information = with_model_error(projected(overlap.information, degeneracy), T_key_body)
            factors = (BetweenFactor(keyframe.node, node, T_key_body, information),)
        else:
            self._add_scan(observation, deskewed, found.T_world_middle, is_keyframe=False)
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
                inliers=overlap.pairs,
                residual=overlap.inlier_rmse_m,
                residual_unit="m",
                method=found.method,
                unobservable=degeneracy.text,
            ),
            factors=factors,
            links=factors,
            twist=self._twist,
        )

    def _start(self, observation: ScanObservation, T_world_body: Transform, *, method: str) -> FrameResult:
        """Make a scan the first keyframe of a map, unconnected to earlier maps."""
        self._matcher.clear()
        self._overlaps.clear()
        self._twist, self._lost_scans, self._first = STILL, 0, observation
        deskewed = observation.deskew(STILL)
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
            return self._start(observation, self._T_world_last, method="new sub-map")
        scan = observation.scan
        return lost_frame(scan.stamp_ns, self._T_world_last, features=len(scan.points_body))

    def _add_keyframe(
        self, observation: ScanObservation, deskewed: DeskewedScan, T_world_middle: Transform
    ) -> int:
        self._add_scan(observation, deskewed, T_world_middle, is_keyframe=True)
        T_world_body = T_world_middle @ self._twist.over(-observation.middle_s)
        self._keyframe = _Keyframe(self._next_node, deskewed, T_world_middle, T_world_body)
        self._next_node += 1
        return self._keyframe.node

    def _add_scan(
        self,
        observation: ScanObservation,
        deskewed: DeskewedScan,
        T_world_middle: Transform,
        *,
        is_keyframe: bool,
    ) -> None:
        self._matcher.add(deskewed, T_world_middle, is_keyframe=is_keyframe)
        self._last_time_ns, self._T_world_last = _time_ns(observation), T_world_middle


def _time_ns(observation: ScanObservation) -> int:
    """Return the middle of a scan's sweep."""
    return observation.scan.stamp_ns + round(observation.middle_s * NS_PER_S)


def _better(one: _PoseCandidate | None, other: _PoseCandidate | None) -> _PoseCandidate | None:
    """Return the pose of more overlap, of equals the first."""
    if one is None or other is None:
        return one or other
    return other if other.overlap.inlier_ratio > one.overlap.inlier_ratio else one
