"""Removal of the sensor's own vehicle from the frames of a log, before they are used."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError
from mapper.core.frames import Frame, RgbdFrame, Scan
from mapper.core.geometry import Transform, apply
from mapper.sources.base import Log, WrappedEntry
from mapper.sources.config import BodyConfig


def without_vehicle(log: Log, config: BodyConfig) -> Log:
    """Return a log whose frames, and those beside it, have no returns of the sensor's own vehicle."""

    def cleared(one: Log, T_body_sensor: Transform) -> Log:
        return replace(one, entry_at=lambda index: _ClearedEntry(one.entry_at(index), config, T_body_sensor))

    beside = [replace(one, log=cleared(one.log, one.T_body_sensor)) for one in log.beside]
    return replace(cleared(log, np.eye(4)), beside=beside)


@dataclass(frozen=True, slots=True)
class _ClearedEntry(WrappedEntry):
    """Frame of another log without the returns of the vehicle; its files include them.

    Attributes:
        config: What is left out; the box is in the body.
        T_body_sensor: (4, 4) pose of the frame's points.
    """

    config: BodyConfig
    T_body_sensor: Transform

    def load(self, *, colour: bool = True) -> Frame:
        """Read the frame; depth of the vehicle is 0, as where nothing was measured.

        Raises:
            FrameError: As the recorded frame, or no return of a scan is left.
        """
        frame = self.entry.load(colour=colour)
        return self._cleared_image(frame) if isinstance(frame, RgbdFrame) else self._cleared(frame)

    def scan(self) -> Scan:
        """Read the returns alone.

        Raises:
            FrameError: As ``load``.
        """
        return self._cleared(self.entry.scan())

    def _cleared(self, scan: Scan) -> Scan:
        kept = self._are_of_the_world(scan)
        if kept.all():
            return scan
        if not kept.any():
            raise FrameError(
                f"frame {scan.stamp_ns}: all {len(kept)} returns are of the vehicle or out of range "
                "(source.body.box, min_range_m, max_range_m)"
            )
        return scan.select(kept)

    def _cleared_image(self, frame: RgbdFrame) -> RgbdFrame:
        kept = self._are_of_the_world(frame.scan())
        if kept.all():
            return frame
        depth_m = frame.depth_m.copy()
        depth_m[depth_m > 0.0] *= kept  # a scan has the measured pixels, row by row
        return replace(frame, depth_m=depth_m)

    def _are_of_the_world(self, scan: Scan) -> NDArray[np.bool_]:
        """Return the (N,) mask of the returns that are not of the vehicle, and in range."""
        points, config = scan.points_body, self.config
        kept = np.ones(len(points), np.bool_)
        if config.box is not None:
            T = self.T_body_sensor
            points_body = points if np.array_equal(T, np.eye(4)) else apply(T, points.astype(np.float64))
            lower, upper = np.array(config.box, np.float32).reshape(2, 3)
            inside = np.ones(len(points), np.bool_)
            for axis in range(3):
                inside &= (points_body[:, axis] >= lower[axis]) & (points_body[:, axis] <= upper[axis])
            kept &= ~inside
        if config.min_range_m > 0.0 or config.max_range_m is not None:
            range_m = np.linalg.norm(points - scan.origin_body.astype(np.float32), axis=1)
            kept &= (range_m >= config.min_range_m) & (range_m <= (config.max_range_m or np.inf))
        return kept
