"""Frames that are read by a function, such as those of every kind of scan."""

from collections.abc import Callable
from dataclasses import dataclass

from mapper.core.frames import Frame, Scan


@dataclass(frozen=True, slots=True)
class LazyFrame:
    """Frame that a function reads, without image files; see :class:`mapper.sources.base.FrameRef`.

    All was measured at the stamp.

    Attributes:
        stamp_ns: Time of the frame, nanoseconds.
        read: Returns the frame. Where its argument is false an image may be grey, and a scan has neither
            colours nor intensities. It raises ``FrameError`` if the frame cannot be used.
    """

    stamp_ns: int
    read: Callable[[bool], Frame]

    @property
    def depth_stamp_ns(self) -> int:
        """Time of the frame, nanoseconds."""
        return self.stamp_ns

    @property
    def files(self) -> None:
        """None, for there are none."""
        return None

    def load(self, *, colour: bool = True) -> Frame:
        """Read the frame.

        Raises:
            FrameError: It cannot be used.
        """
        return self.read(colour)

    def scan(self) -> Scan:
        """Read the returns alone.

        Raises:
            FrameError: As ``load``.
        """
        return self.read(False).scan()
