"""The seam between a log and the pose graph: what tracking one frame yields."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapper.core.deskew import Twist
from mapper.core.frames import Frame
from mapper.core.geometry import Array, Transform
from mapper.features.scan_view import ScanView
from mapper.features.view import View
from mapper.graph.model import BetweenFactor
from mapper.sources.base import FrameRef


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """How tracking one frame went.

    Attributes:
        features: Features found in the image.
        matches: Pairs proposed by matching.
        inliers: Pairs that agree with the pose.
        residual: Root mean square residual of the inliers.
        residual_unit: "m" or "px".
        method: What placed the frame, e.g. "map", "fallback", "relocalised", "lost".
        unseen: Motions that the surfaces left open, e.g. "translation along x"; empty when none.
    """

    features: int
    matches: int
    inliers: int
    residual: float
    residual_unit: str
    method: str
    unseen: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """One tracked frame.

    Attributes:
        stamp_ns: The frame's stamp.
        node: Graph node that the frame's pose hangs on, or None when the frame is lost.
        T_node_body: (4, 4) pose of the body in that node.
        T_world_body: (4, 4) the odometry's own running estimate; the last good one while lost.
        is_keyframe: The frame itself became ``node``.
        factors: Measurements that became final with this frame; their nodes are known by now.
        diagnostics: How it went.
        links: Where the new node lies from earlier ones, as far as is known now; ``factors`` may come later
            and better, but until then this is what ties the node to the path.
        twist: How the body is taken to have moved while a scan was swept; None where nothing was deskewed.
        is_sharp: False of what nobody should recognise a place by: a scan swept in unknown motion.
    """

    stamp_ns: int
    node: int | None
    T_node_body: Transform
    T_world_body: Transform
    is_keyframe: bool
    diagnostics: Diagnostics
    factors: Sequence[BetweenFactor] = field(default_factory=tuple)
    links: Sequence[BetweenFactor] = field(default_factory=tuple)
    twist: Twist | None = None
    is_sharp: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """How the features of a frame's view hold its pose.

    Attributes:
        agreeing: (N,) which agree with it.
        before_px: (N, 2) undistorted pixels: where they were in the frame before, or in a keyframe; NaN where
            neither showed them.
    """

    agreeing: NDArray[np.bool_]
    before_px: Array


Observation = TypeVar("Observation")

Seen = View | ScanView
"""What a place is recognised by, of one sensor or the other."""


class Odometry(Protocol[Observation]):
    """Frame-by-frame tracking, split so that the costly, stateless half can run ahead in threads."""

    def read(self, entry: FrameRef) -> Observation:
        """Reduce a log's frame to what tracking needs, and read no more. Pure: no state is read or written.

        Raises:
            FrameError: The frame cannot be read, or is of a kind that this method cannot use.
        """
        ...

    def track(self, observation: Observation) -> FrameResult:
        """Place the next observation, in time order."""
        ...

    def view(self, observation: Observation, twist: Twist | None = None, /) -> Seen:
        """Return what a place is recognised by. Pure.

        Args:
            observation: Of the frame.
            twist: How the body moved while a scan was swept; images do not look at it.

        Raises:
            FrameError: The frame was not needed before, and cannot be read.
        """
        ...

    def matches(self) -> Matches | None:
        """Return what holds the frame that was tracked last; None if it was lost, or is held by no features.

        It is for looking, and so made when it is asked for.
        """
        ...

    def finish(self) -> Sequence[BetweenFactor]:
        """Return the measurements that were still being refined when the log ended."""
        ...


class FrameOdometry(Odometry[Observation], Protocol[Observation]):
    """An odometry that sees each frame, and so can be given one that is no log's."""

    def observe(self, frame: Frame) -> Observation:
        """Reduce a frame to what tracking needs. Pure: no state is read or written.

        Raises:
            FrameError: The frame is of a kind that this method cannot use.
        """
        ...
