"""Interface of the odometries: the result of tracking one frame, and the methods that produce it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mapper.core.doubts import Doubt
from mapper.core.frames import Frame
from mapper.core.geometry import Array, Transform
from mapper.core.timebase import NS_PER_S
from mapper.graph.model import BetweenFactor
from mapper.sources.base import FrameRef

if TYPE_CHECKING:
    from mapper.core.deskew import Motion
    from mapper.features.frame_view import FrameView
    from mapper.odometry.gyroscope_calibration import GyroscopeCalibration


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """Figures on the tracking of one frame.

    Attributes:
        features: Number of features found in the image, or of points of the thinned scan.
        matches: Number of pairs proposed by matching.
        inliers: Number of pairs that agree with the pose.
        residual: Root mean square residual of the inliers.
        residual_unit: "m" or "px".
        method: Step that found the pose, e.g. "map", "fallback", "relocalised", "lost".
        unobservable: Motions that the surfaces do not constrain, e.g. "translation along x"; empty if none.
    """

    features: int = 0
    matches: int = 0
    inliers: int = 0
    residual: float = 0.0
    residual_unit: str = ""
    method: str = ""
    unobservable: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """One tracked frame.

    Attributes:
        stamp_ns: The frame's stamp.
        node: Graph node relative to which the frame's pose is known; None if the frame is lost.
        T_node_body: (4, 4) pose of the body in that node.
        T_world_body: (4, 4) the odometry's own running estimate; while lost, that of the last tracked frame.
        is_keyframe: The frame itself became ``node``.
        factors: Measurements that became final with this frame; their nodes exist by now.
        diagnostics: Figures on how it was tracked.
        links: Preliminary measurements of a new node relative to earlier ones. ``factors`` may come later and
            be more accurate; until then these connect the node to the path.
        twist: Assumed motion of the body during a scan's sweep; None if nothing was deskewed.
        is_sharp: False if the frame is unfit for place recognition: a scan swept in unknown motion.
        doubts: Why the pose may be wrong; empty if there is no reason.
        covariance: (6, 6) of the pose in the body's tangent (rotation, translation), rad² and m²: relative to
            ``node``, or for a keyframe to the keyframe before it. None if nothing measured it.
    """

    stamp_ns: int
    node: int | None
    T_node_body: Transform
    T_world_body: Transform
    is_keyframe: bool
    diagnostics: Diagnostics
    factors: Sequence[BetweenFactor] = field(default_factory=tuple)
    links: Sequence[BetweenFactor] = field(default_factory=tuple)
    twist: Motion | None = None
    is_sharp: bool = True
    doubts: tuple[Doubt, ...] = ()
    covariance: Array | None = None

    def renumbered(self, offset: int) -> FrameResult:
        """Return the result with a constant added to its node numbers."""
        if offset == 0:
            return self
        return replace(
            self,
            node=None if self.node is None else self.node + offset,
            factors=[factor.renumbered(offset) for factor in self.factors],
            links=[link.renumbered(offset) for link in self.links],
        )


def lost_frame(
    stamp_ns: int,
    T_world_body: Transform,
    *,
    features: int = 0,
    residual_unit: str = "m",
    method: str = "lost",
) -> FrameResult:
    """Return the result of a frame that was not found; ``T_world_body`` is that of the last tracked frame."""
    diagnostics = Diagnostics(features, 0, 0, 0.0, residual_unit, method)
    return FrameResult(stamp_ns, None, np.eye(4), T_world_body, False, diagnostics)


@dataclass(frozen=True, slots=True, eq=False)
class FeatureMatches:
    """Matches behind the pose of a frame, one row per feature of its view.

    Attributes:
        is_inlier: (N,) which features agree with the pose.
        previous_px: (N, 2) undistorted pixels of the same points in the frame before, or in a keyframe; NaN
            if neither has them.
    """

    is_inlier: NDArray[np.bool_]
    previous_px: Array


def see_more(*, has_wheels: bool) -> str:
    """Return what to try where ``Diagnostics.unobservable`` names a motion in most frames."""
    wheels = "" if has_wheels else "wheel odometry (wheels.txt), "
    return (
        f"a motion that no surface shows takes {wheels}the poses of another odometry (odometry.kind=given), "
        "or a sensor that sees farther; loops do not show it"
    )


_MAX_STEADY_NS = NS_PER_S


def is_gap(begin_ns: int, end_ns: int) -> bool:
    """Return whether an earlier frame is so old that it does not predict the pose of a later one."""
    return end_ns - begin_ns > _MAX_STEADY_NS


class MotionCheck(Protocol):
    """Other measurement of the body's motion, which holds whatever the images show.

    Poses found after a gap (``is_gap``), or in another sub-map, have to pass it.
    """

    def contradiction(self, T_begin_end: Transform, begin_ns: int, end_ns: int) -> str:
        """Return why a motion (4, 4) between two times cannot be; empty if it can, or nothing is known."""
        ...


Observation = TypeVar("Observation")


@runtime_checkable
class Odometry(Protocol[Observation]):
    """Frame-by-frame tracking in two steps, the first of them stateless, so that threads can run it ahead."""

    def read(self, entry: FrameRef) -> Observation:
        """Reduce a log's frame to what tracking needs, and read no more. Pure: no state is read or written.

        Raises:
            FrameError: The frame cannot be read, or is of a kind that this method cannot use.
        """
        ...

    def track(self, observation: Observation) -> FrameResult:
        """Track the next frame, in time order."""
        ...

    def view(self, observation: Observation, twist: Motion | None = None, /) -> FrameView:
        """Return the view for place recognition. Pure.

        Args:
            observation: Observation of the frame.
            twist: Motion of the body during a scan's sweep; not used for images.

        Raises:
            FrameError: The frame was not needed before, and cannot be read.
        """
        ...

    def matches(self) -> FeatureMatches | None:
        """Return the matches of the last frame; None if it was lost or its pose is not from features.

        They are for display only, and so are computed on request.
        """
        ...

    def finish(self) -> Sequence[BetweenFactor]:
        """Return the measurements that were still being refined when the log ended."""
        ...


@runtime_checkable
class SensorCheck(Protocol):
    """Odometry that finds out about the sensor while it tracks."""

    def sensor_notes(self) -> Sequence[str]:
        """Return what is known about the sensor once the log has ended, a sentence each."""
        ...

    def calibration_warnings(self) -> Sequence[str]:
        """Return what in the log contradicts the sensor's calibration, a sentence each."""
        ...


@runtime_checkable
class GyroscopeUser(Protocol):
    """Odometry whose prediction of the motion uses a gyroscope."""

    def gyroscope_notes(self) -> Sequence[str]:
        """Return how it was used once the log has ended, a sentence each; nothing if the log has none."""
        ...

    def gyroscope_calibration(self) -> GyroscopeCalibration | None:
        """Return its calibration by the frames until now; None if it was of no use."""
        ...

    def begin_calibrated(self, calibration: GyroscopeCalibration, frames: int) -> None:
        """Begin with its calibration by that many first frames, which are tracked again."""
        ...


class FrameOdometry(Odometry[Observation], Protocol[Observation]):
    """Odometry from images or scans, which accepts frames that are of no log."""

    def read(self, entry: FrameRef) -> Observation:
        """Observe a log's frame, without its colours. Pure.

        Raises:
            FrameError: The frame cannot be read, or is of a kind that this method cannot use.
        """
        return self.observe(entry.load(colour=False))

    def finish(self) -> Sequence[BetweenFactor]:
        """Return nothing: every measurement was final when its frame was tracked."""
        return ()

    def observe(self, frame: Frame) -> Observation:
        """Reduce a frame to what tracking needs. Pure: no state is read or written.

        Raises:
            FrameError: The frame is of a kind that this method cannot use.
        """
        ...
