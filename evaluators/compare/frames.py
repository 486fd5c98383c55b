"""A log's frames, prepared in the same way for every method."""

import time
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.frames import Frame, RgbdFrame, Scan
from mapper.core.geometry import Transform, inverse
from mapper.evaluators.compare.config import RgbdCompareConfig
from mapper.sources.base import FrameRef

# An optical frame looks along z with y down; methods for scans expect x ahead and z up.
_T_OPTICAL_UPRIGHT = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


@dataclass(frozen=True, slots=True, eq=False)
class PreparedFrame:
    """One frame as the methods get it.

    Attributes:
        frame: Frame as the log has it; an RGB-D frame is grey.
        scan: Its points in an upright frame: x ahead, z up.
        T_body_scan: (4, 4) pose of that frame in the body.
    """

    frame: Frame
    scan: Scan
    T_body_scan: Transform

    def upright(self, T_body_body: Transform) -> Transform:
        """Return a motion of the body as a motion of the scans' frame."""
        return inverse(self.T_body_scan) @ T_body_body @ self.T_body_scan


class FrameReader:
    """Reads frames, and counts the CPU time of reading.

    Attributes:
        read_s: Seconds of the CPU for reading and decoding.
        scan_s: Seconds of the CPU for making scans of depth images.
    """

    def __init__(self, config: RgbdCompareConfig) -> None:
        """Begin at zero.

        Args:
            config: Settings by which depth images become scans.
        """
        self._config = config
        self.read_s = self.scan_s = 0.0

    def read(self, entry: FrameRef) -> PreparedFrame:
        """Return a frame of the log.

        Raises:
            FrameError: It cannot be read.
        """
        began = time.process_time()
        frame = entry.load(colour=False)
        loaded = time.process_time()
        prepared = self._prepared(frame)
        self.read_s += loaded - began
        self.scan_s += time.process_time() - loaded
        return prepared

    def _prepared(self, frame: Frame) -> PreparedFrame:
        if not isinstance(frame, RgbdFrame):
            # Without times no method deskews: registrations of pairs could not, for they know no motion.
            return PreparedFrame(frame, replace(frame, times_s=None), np.eye(4))
        scan = frame.scan(stride_px=self._config.stride_px, max_depth_m=self._config.max_depth_m)
        R_body_scan = _T_OPTICAL_UPRIGHT[:3, :3]
        points = np.ascontiguousarray(scan.points_body @ R_body_scan.astype(np.float32))
        return PreparedFrame(
            frame, Scan(scan.stamp_ns, points, scan.origin_body @ R_body_scan), _T_OPTICAL_UPRIGHT
        )
