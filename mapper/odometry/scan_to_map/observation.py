"""What a scan is reduced to before it is placed."""

from dataclasses import dataclass, replace

import numpy as np

from mapper.core.deskew import STILL, Twist, deskewed
from mapper.core.errors import FrameError
from mapper.core.frames import Frame, Points32, Scan
from mapper.core.voxel_grid import thin
from mapper.features.scan_view import ScanView
from mapper.odometry.scan_to_map.config import ScanOdometryConfig
from mapper.odometry.scan_to_map.matching import Sweep
from mapper.registration.surfaces import prepared

_MIN_POINTS = 100
"""Fewer points left after thinning do not constrain a pose."""
_FINER = 0.5  # a prepared point is the mean of those thinned to this part of its voxel


@dataclass(frozen=True, slots=True, eq=False)
class ScanObservation:
    """A thinned scan.

    Attributes:
        scan: Points in range, body frame, with their times where the log has them.
        middle_s: Middle of the sweep, seconds after the scan's stamp; 0 without times.
        sweep: The scan as taken all at once; None while that waits for the motion during the sweep.
        voxel_m: Voxels that a sweep is prepared with.
    """

    scan: Scan
    middle_s: float
    sweep: Sweep | None
    voxel_m: float

    def as_swept(self, twist: Twist) -> Sweep:
        """Return the scan as taken all at once in the middle of the sweep, if the body moved like this.

        There an error of the motion cancels: half of the points move one way and half the other. At the
        sweep's start it would move the pose, and so come back larger in the next motion.
        """
        return self.sweep or _sweep(self._deskewed(twist, moment_s=self.middle_s), self.voxel_m)

    def points_at_stamp(self, twist: Twist) -> Points32:
        """Return (M, 3) points as taken all at once at the stamp, one per voxel."""
        points = self._deskewed(twist, moment_s=0.0).points_body
        return points[thin(points, self.voxel_m)]

    def view(self, twist: Twist | None) -> ScanView:
        """Return the points as taken all at once at the stamp, for place recognition; None is no motion."""
        return ScanView(self.scan.stamp_ns, self.points_at_stamp(twist or STILL))

    def _deskewed(self, twist: Twist, *, moment_s: float) -> Scan:
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
        return ScanObservation(thinned, 0.0, _sweep(thinned, config.voxel_m), config.voxel_m)
    times_s = scan.times_s[in_range][kept]
    middle_s = 0.5 * float(times_s.min() + times_s.max())
    return ScanObservation(replace(thinned, times_s=times_s), middle_s, None, config.voxel_m)


def _sweep(scan: Scan, voxel_m: float) -> Sweep:
    return Sweep(scan, prepared(scan.points_body, voxel_m=voxel_m))
