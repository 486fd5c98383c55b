"""An odometry whose nodes follow those of earlier sessions."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Generic

from mapper.core.deskew import Twist
from mapper.graph.model import BetweenFactor
from mapper.odometry.base import FrameResult, Matches, Observation, Odometry, Seen
from mapper.sources.base import FrameRef


class NodeOffset(Generic[Observation]):
    """Raises the node numbers of an odometry; see :class:`mapper.odometry.base.Odometry`."""

    def __init__(self, odometry: Odometry[Observation], *, first_node: int) -> None:
        self._odometry = odometry
        self._first_node = first_node

    def read(self, entry: FrameRef) -> Observation:
        """Reduce a frame to what tracking needs. Pure."""
        return self._odometry.read(entry)

    def track(self, observation: Observation) -> FrameResult:
        """Place the next observation, in time order."""
        track = self._odometry.track(observation)
        return replace(
            track,
            node=None if track.node is None else track.node + self._first_node,
            factors=self._raised(track.factors),
            links=self._raised(track.links),
        )

    def view(self, observation: Observation, twist: Twist | None = None, /) -> Seen:
        """Return what a place is recognised by. Pure."""
        return self._odometry.view(observation, twist)

    def matches(self) -> Matches | None:
        """Return what holds the frame that was tracked last."""
        return self._odometry.matches()

    def finish(self) -> Sequence[BetweenFactor]:
        """Return the measurements that were still being refined when the log ended."""
        return self._raised(self._odometry.finish())

    def _raised(self, factors: Iterable[BetweenFactor]) -> tuple[BetweenFactor, ...]:
        return tuple(
            replace(factor, i=factor.i + self._first_node, j=factor.j + self._first_node)
            for factor in factors
        )
