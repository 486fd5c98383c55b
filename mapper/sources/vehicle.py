"""Removal of the sensor's own vehicle from the frames of a log, before they are used."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError
from mapper.core.frames import Frame, RgbdFrame, Scan
from mapper.sources.base import Log, WrappedEntry
from mapper.sources.config import BodyConfig


def without_vehicle(log: Log, config: BodyConfig) -> Log:
    """Return a log whose frames have no returns of the sensor's own vehicle."""
    return replace(log, entry_at=lambda index: _ClearedEntry(log.entry_at(index), config))


@dataclass(frozen=True, slots=True)
class _ClearedEntry(WrappedEntry):
    """Frame of another log without the returns of the vehicle; its files include them."""

    config: BodyConfig

    def load(self, *, colour: bool = True) -> Frame:
        """Read the frame; depth of the vehicle is 0, as where nothing was measured.

        Raises:
            FrameError: As the recorded frame, or no return of a scan is left.
        """
        frame = self.entry.load(colour=colour)
        return _cleared_image(frame, self.config) if isinstance(frame, RgbdFrame) else self._cleared(frame)

    def scan(self) -> Scan:
        """Read the returns alone.

        Raises:
            FrameError: As ``load``.
        """
        return self._cleared(self.entry.scan())

    def _cleared(self, scan: Scan) -> Scan:
        kept = are_of_the_world(scan, self.config)
        if kept.all():
            return scan
        if not kept.any():
            raise FrameError(
                f"frame {scan.stamp_ns}: all {len(kept)} returns are of the vehicle or out of range "
                "(source.body.box, min_range_m, max_range_m)"
            )
        return scan.select(kept)


def are_of_the_world(scan: Scan, config: BodyConfig) -> NDArray[np.bool_]:
    """Return the (N,) mask of the returns that are not of the vehicle, and in range."""
    points_body = scan.points_body
    kept = np.ones(len(points_body), np.bool_)
    if config.box is not None:
        lower, upper = np.array(config.box, np.float32).reshape(2, 3)
        inside = np.ones(len(points_body), np.bool_)
        for axis in range(3):
            inside &= (points_body[:, axis] >= lower[axis]) & (points_body[:, axis] <= upper[axis])
        kept &= ~inside
    if config.min_range_m > 0.0 or config.max_range_m is not None:
        range_m = np.linalg.norm(points_body - scan.origin_body.astype(np.float32), axis=1)
        kept &= (range_m >= config.min_range_m) & (range_m <= (config.max_range_m or np.inf))
    return kept


def _cleared_image(frame: RgbdFrame, config: BodyConfig) -> RgbdFrame:
    kept = are_of_the_world(frame.scan(), config)
    if kept.all():
        return frame
    depth_m = frame.depth_m.copy()
    depth_m[depth_m > 0.0] *= kept  # a scan has the measured pixels, row by row
    return replace(frame, depth_m=depth_m)
