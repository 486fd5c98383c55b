"""Times of a LiDAR's points as the user says they are: scaled, ignored, or by azimuth."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Frame, Scan
from mapper.sources.base import Log, WrappedEntry
from mapper.sources.point_times import azimuth_times_s


def with_point_times(log: Log, *, time_scale: float, sweep_s: float | None) -> Log:
    """Return a log whose scans have other times.

    Args:
        log: Log of a LiDAR.
        time_scale: Factor on the times of the points; 0 leaves them out.
        sweep_s: Duration of a turn of scans without times, which get some by azimuth; None leaves them.
    """
    return replace(log, entry_at=lambda index: _TimedEntry(log.entry_at(index), time_scale, sweep_s))


@dataclass(frozen=True, slots=True)
class _TimedEntry(WrappedEntry):
    """Scan of another log with other times; its files have those that were recorded."""

    time_scale: float
    sweep_s: float | None

    def load(self, *, colour: bool = True) -> Frame:
        """Read the scan.

        Raises:
            FrameError: As the recorded scan.
        """
        frame = self.entry.load(colour=colour)
        return self._timed(frame) if isinstance(frame, Scan) else frame

    def scan(self) -> Scan:
        """Read the scan.

        Raises:
            FrameError: As the recorded scan.
        """
        return self._timed(self.entry.scan())

    def _timed(self, scan: Scan) -> Scan:
        if scan.times_s is not None:
            return replace(scan, times_s=_scaled(scan.times_s, self.time_scale))
        if self.sweep_s is None:
            return scan
        return replace(scan, times_s=azimuth_times_s(scan.points_body, scan.origin_body, self.sweep_s))


def _scaled(times_s: NDArray[np.float32], scale: float) -> NDArray[np.float32] | None:
    """Return scaled times; None for a scale of 0.

    Of times that count backwards the largest is that of the stamp: of those until the end of the sweep, and
    of negative ones that ought to be positive.
    """
    if scale == 0.0 or len(times_s) == 0:
        return None
    from_s = times_s.max() if scale < 0.0 else np.float32(0.0)
    return np.float32(scale) * (times_s - from_s)
