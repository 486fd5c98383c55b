"""Odometry whose nodes are numbered after those of earlier sessions."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Generic

from mapper.core.deskew import Motion
from mapper.features.frame_view import FrameView
from mapper.graph.model import BetweenFactor
from mapper.odometry.base import FeatureMatches, FrameResult, GyroscopeUser, Observation, Odometry
from mapper.odometry.gyroscope_calibration import GyroscopeCalibration
from mapper.sources.base import FrameRef


class NodeOffset(Generic[Observation]):
    """Odometry with a constant added to its node numbers; see :class:`mapper.odometry.base.Odometry`."""

    def __init__(self, odometry: Odometry[Observation], *, first_node: int) -> None:
        self._odometry = odometry
        self._first_node = first_node

    def read(self, entry: FrameRef) -> Observation:
        """Reduce a log's frame to what tracking needs. Pure."""
        return self._odometry.read(entry)

    def track(self, observation: Observation) -> FrameResult:
        """Track the next frame, in time order."""
        return _numbered(self._odometry.track(observation), self._first_node)

    def view(self, observation: Observation, twist: Motion | None = None, /) -> FrameView:
        """Return the view for place recognition. Pure."""
        return self._odometry.view(observation, twist)

    def matches(self) -> FeatureMatches | None:
        """Return the matches of the frame tracked last."""
        return self._odometry.matches()

    def gyroscope_notes(self) -> Sequence[str]:
        """Return how the gyroscope was used."""
        return self._odometry.gyroscope_notes() if isinstance(self._odometry, GyroscopeUser) else ()

    def gyroscope_calibration(self) -> GyroscopeCalibration | None:
        """Return the gyroscope's calibration."""
        return self._odometry.gyroscope_calibration() if isinstance(self._odometry, GyroscopeUser) else None

    def finish(self) -> Sequence[BetweenFactor]:
        """Return the measurements that were still being refined when the log ended."""
        return _numbered_factors(self._odometry.finish(), self._first_node)


def _numbered(result: FrameResult, offset: int) -> FrameResult:
    """Return a result with a constant added to its node numbers."""
    return replace(
        result,
        node=None if result.node is None else result.node + offset,
        factors=_numbered_factors(result.factors, offset),
        links=_numbered_factors(result.links, offset),
    )


def _numbered_factors(factors: Iterable[BetweenFactor], offset: int) -> tuple[BetweenFactor, ...]:
    return tuple(replace(factor, i=factor.i + offset, j=factor.j + offset) for factor in factors)
