"""Observation of one scan: the points in range, thinned."""

from dataclasses import dataclass, replace

import numpy as np

from mapper.core.deskew import STILL, Twist, deskewed
from mapper.core.errors import FrameError
from mapper.core.frames import Frame, Scan
from mapper.core.voxel_grid import thin
from mapper.features.frame_view import ScanView
from mapper.odometry.scan_to_map.config import ScanOdometryConfig
from mapper.odometry.scan_to_map.scan_matcher import DeskewedScan
from mapper.registration.surfaces import prepared

_MIN_POINTS = 100
"""Fewer points left after thinning do not constrain a pose."""
_FINER = 0.5  # voxel size of the first thinning, of whose points each prepared point is the mean


@dataclass(frozen=True, slots=True, eq=False)
class ScanObservation:
    """A thinned scan.

    Attributes:
        scan: Points in range, body frame, with their times if the log has them.
        middle_s: Middle of the sweep, seconds after the scan's stamp; 0 without times.
        deskewed: The scan as taken all at once; None if that depends on the motion during the sweep.
        voxel_m: Voxel size of the prepared points.
    """

    scan: Scan
    middle_s: float
    deskewed: DeskewedScan | None
    voxel_m: float

    def deskew(self, twist: Twist) -> DeskewedScan:
        """Return the scan as taken all at once in the middle of the sweep, under a constant velocity.

        In the middle an error of the velocity cancels: half of the points move one way and half the other. At
        the start of the sweep it would move the pose, and so increase the next velocity's error.
        """
        return self.deskewed or _prepared(self._scan_at(self.middle_s, twist), self.voxel_m)

    def view(self, twist: Twist | None) -> ScanView:
        """Return the points as taken all at once at the stamp, one per voxel; no twist is no motion."""
        points = self._scan_at(0.0, twist or STILL).points_body
        return ScanView(self.scan.stamp_ns, points[thin(points, self.voxel_m)])

    def _scan_at(self, moment_s: float, twist: Twist) -> Scan:
        if self.scan.times_s is None:
            return self.scan
        return deskewed(replace(self.scan, times_s=self.scan.times_s - np.float32(moment_s)), twist)


def observe_scan(frame: Frame, config: ScanOdometryConfig) -> ScanObservation:
    """Return a frame's points in range, thinned; prepared for registration unless they are to be deskewed.

    Raises:
        FrameError: Too few points are in range.
    """
    scan = frame.scan()
    range_m = np.linalg.norm(scan.points_body - scan.origin_body.astype(np.float32), axis=1)
    in_range = np.flatnonzero((range_m >= config.min_range_m) & (range_m <= config.max_range_m))
    points_body = scan.points_body[in_range]
    kept = thin(points_body, _FINER * config.voxel_m)
    if len(kept) < _MIN_POINTS:
        raise FrameError(
            f"scan {scan.stamp_ns}: {len(scan.points_body)} points, of which {len(kept)} are left between "
            f"{config.min_range_m:g} m and {config.max_range_m:g} m and {_FINER * config.voxel_m:g} m apart; "
            f"want {_MIN_POINTS} (odometry.min_range_m, max_range_m, voxel_m)"
        )
    thinned = replace(scan, points_body=points_body[kept], colors=None, times_s=None)
    if scan.times_s is None:
        return ScanObservation(thinned, 0.0, _prepared(thinned, config.voxel_m), config.voxel_m)
    times_s = scan.times_s[in_range][kept]
    middle_s = 0.5 * float(times_s.min() + times_s.max())
    return ScanObservation(replace(thinned, times_s=times_s), middle_s, None, config.voxel_m)


def _prepared(scan: Scan, voxel_m: float) -> DeskewedScan:
    return DeskewedScan(scan, prepared(scan.points_body, voxel_m=voxel_m))
