"""Correction of the depth of a log's frames, before any other part of mapper sees them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import SourceError
from mapper.core.frames import Frame, RgbdFrame, Scan
from mapper.sources.base import Log, WrappedEntry

_LEAST_RATIO = 0.1
"""Inverse depths of which less is left are of no surface: their depth is 0."""


def with_corrected_depth(log: Log, inverse_depth_offset_per_m: float) -> Log:
    """Return a log with a number added to the inverse of every measured depth.

    Raises:
        SourceError: The log has no depth images.
    """
    if log.sensor != "rgbd":
        raise SourceError(
            f"{log.path}: source.inverse_depth_offset_per_m corrects depth images, and these are scans; "
            "leave it out"
        )
    return replace(
        log, entry_at=lambda index: _CorrectedEntry(log.entry_at(index), inverse_depth_offset_per_m)
    )


@dataclass(frozen=True, slots=True)
class _CorrectedEntry(WrappedEntry):
    """Frame of another log with its depth corrected; its files are as recorded."""

    offset_per_m: float

    def load(self, *, colour: bool = True) -> Frame:
        """Read the frame.

        Raises:
            FrameError: As the recorded frame.
        """
        frame = self.entry.load(colour=colour)
        assert isinstance(frame, RgbdFrame)
        return replace(frame, depth_m=frame.depth_m / self._ratio(frame.depth_m))

    def scan(self) -> Scan:
        """Read the depth image alone.

        Raises:
            FrameError: As ``load``.
        """
        scan = self.entry.scan()
        ratio = self._ratio(scan.points_body[:, 2])  # the body of an RGB-D frame is its camera
        kept = np.isfinite(ratio)
        return replace(
            scan,
            points_body=scan.points_body[kept] / ratio[kept, np.newaxis],
            colors=None if scan.colors is None else scan.colors[kept],
        )

    def _ratio(self, depth_m: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return by which factor inverse depths change; infinity where no depth is left."""
        ratio = np.float32(1.0) + np.float32(self.offset_per_m) * depth_m.astype(np.float32)
        return np.where(ratio > _LEAST_RATIO, ratio, np.float32(np.inf))
