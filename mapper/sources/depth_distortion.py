"""Depth distortion of a log's camera: measured in some of its frames, and removed from all of them."""

import threading
from dataclasses import dataclass, field, replace

from mapper.core.frames import Frame, RgbdFrame, Scan, ray_table
from mapper.sensing.depth_distortion import DepthDistortion, measure_distortion
from mapper.sources.base import Log, WrappedEntry, read_depth

_FRAMES = 60


def distortion_of(log: Log) -> DepthDistortion | None:
    """Measure the depth distortion in frames spread over a log; None if there is none, or no depth images."""
    if log.sensor != "rgbd":
        return None
    frames = (frame for entry in log.spread_entries(_FRAMES) if (frame := read_depth(entry)) is not None)
    first = next(frames, None)
    if first is None:
        return None
    images = (frame.depth_m for frame in (first, *frames) if frame.camera == first.camera)
    return measure_distortion(images, ray_table(first.camera))


def undistorted(log: Log) -> Log:
    """Return an RGB-D log whose depth images have no distortion; any other log stays as it is.

    The distortion is measured when the first frame is loaded. Where none is found, the frames stay as they
    are.
    """
    if log.sensor != "rgbd":
        return log
    measured = _MeasuredOnce(log)
    return replace(
        log,
        entry_at=lambda index: _UndistortedEntry(log.entry_at(index), measured),
        removed_distortion=measured.distortion,
    )


@dataclass(slots=True, eq=False)
class _MeasuredOnce:
    """Distortion of a log, measured on first use, by one thread."""

    log: Log
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _is_known: bool = False
    _distortion: DepthDistortion | None = None

    def distortion(self) -> DepthDistortion | None:
        """Return it; None if there is none."""
        with self._lock:
            if not self._is_known:
                self._distortion, self._is_known = distortion_of(self.log), True
            return self._distortion


@dataclass(frozen=True, slots=True)
class _UndistortedEntry(WrappedEntry):
    """Frame of another log without its depth's distortion; its files have it."""

    measured: _MeasuredOnce

    def load(self, *, colour: bool = True) -> Frame:
        """Read the frame.

        Raises:
            FrameError: As the recorded frame.
        """
        frame = self.entry.load(colour=colour)
        distortion = self.measured.distortion()
        if distortion is None or not isinstance(frame, RgbdFrame):
            return frame
        if frame.depth_m.shape != distortion.error_per_m.shape:  # of another camera
            return frame
        return replace(
            frame,
            depth_m=distortion.corrected(frame.depth_m),
            removed_distortion_per_m=distortion.rms_per_m,
        )

    def scan(self) -> Scan:
        """Read the returns alone.

        Raises:
            FrameError: As ``load``.
        """
        return self.load(colour=False).scan()
