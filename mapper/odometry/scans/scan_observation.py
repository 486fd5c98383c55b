"""Observation of one scan: the points in range, thinned."""

from dataclasses import dataclass, replace

import numpy as np

from mapper.core.deskew import STILL, Motion, deskewed
from mapper.core.errors import FrameError
from mapper.core.frames import Frame, Scan
from mapper.core.timebase import NS_PER_S
from mapper.core.voxel_grid import thin, thin_in_range
from mapper.features.frame_view import ScanView
from mapper.odometry.scans.config import ScanOdometryConfig
from mapper.odometry.scans.scan_matcher import DeskewedScan
from mapper.registration.surfaces import prepared

_MIN_POINTS, _MIN_PLANAR_POINTS = 100, 30
"""Fewer points left after thinning do not constrain a pose; in a plane it has half of the motions."""
_FINER = 0.5  # voxel size of the first thinning, of whose points each prepared point is the mean


@dataclass(frozen=True, slots=True, eq=False)
class ScanObservation:
    """A thinned scan.

    Attributes:
        scan: Points in range, body frame, with their times if the log has them.
        middle_s: Middle of the sweep, seconds after the scan's stamp; 0 without times.
        half_s: Half of the sweep's duration, seconds; 0 without times.
        range_m: Median distance of the points from the sensor.
        deskewed: The scan as taken all at once; None if that depends on the motion during the sweep.
        voxel_m: Voxel size of the prepared points.
    """

    scan: Scan
    middle_s: float
    half_s: float
    range_m: float
    deskewed: DeskewedScan | None
    voxel_m: float

    @property
    def middle_ns(self) -> int:
        """Time of the middle of the sweep."""
        return self.scan.stamp_ns + round(self.middle_s * NS_PER_S)

    def deskew(self, motion: Motion) -> DeskewedScan:
        """Return the scan as taken all at once in the middle of the sweep, under a motion about it.

        In the middle an error of the velocity cancels: half of the points move one way and half the other. At
        the start of the sweep it would move the pose, and so increase the next velocity's error.
        """
        return self.deskewed or _prepared(deskewed(self.sweep(self.middle_s), motion), self.voxel_m)

    def displacement(self, turning_radps: float) -> float:
        """Return how far a change of the rotation, rad/s, displaces the sweep's outer points, in voxels."""
        return turning_radps * self.half_s * self.range_m / self.voxel_m

    def view(self, motion: Motion | None) -> ScanView:
        """Return the points as taken all at once at the stamp, one per voxel; None is no motion."""
        points = deskewed(self.scan, motion or STILL).points_body
        return ScanView(
            self.scan.stamp_ns, points if self.scan.is_planar else points[thin(points, self.voxel_m)]
        )

    def sweep(self, moment_s: float) -> Scan:
        """Return the points with times from a moment after the stamp, seconds."""
        if self.scan.times_s is None:
            return self.scan
        return replace(self.scan, times_s=self.scan.times_s - np.float32(moment_s))


def observe_scan(frame: Frame, config: ScanOdometryConfig) -> ScanObservation:
    """Return a frame's points in range, thinned; prepared for registration unless they are to be deskewed.

    Raises:
        FrameError: Too few points are in range.
    """
    scan = frame.scan()
    if scan.is_planar:
        scan = _in_its_plane(scan)
    fewest = _MIN_PLANAR_POINTS if scan.is_planar else _MIN_POINTS
    kept, ranges_m = thin_in_range(
        scan.points_body,
        scan.origin_body.astype(np.float32),
        config.min_range_m,
        config.max_range_m,
        # A planar scan has few points, and the free-space check needs all of its rays.
        0.0 if scan.is_planar else _FINER * config.voxel_m,
    )
    if len(kept) < fewest:
        raise FrameError(
            f"scan {scan.stamp_ns}: {len(scan.points_body)} points, of which {len(kept)} are left between "
            f"{config.min_range_m:g} m and {config.max_range_m:g} m and {_FINER * config.voxel_m:g} m apart; "
            f"want {fewest} (odometry.min_range_m, max_range_m, voxel_m; source.cloud_scale where these "
            "are no metres)"
        )
    thinned = replace(scan, points_body=scan.points_body[kept], colors=None, times_s=None, intensities=None)
    median_m = float(np.median(ranges_m))
    if scan.times_s is None:
        whole = _prepared(thinned, config.voxel_m)
        return ScanObservation(thinned, 0.0, 0.0, median_m, whole, config.voxel_m)
    times_s = scan.times_s[kept]
    first_s, last_s = float(times_s.min()), float(times_s.max())
    middle_s, half_s = 0.5 * (first_s + last_s), 0.5 * (last_s - first_s)
    swept = replace(thinned, times_s=times_s)
    return ScanObservation(swept, middle_s, half_s, median_m, None, config.voxel_m)


def _in_its_plane(scan: Scan) -> Scan:
    """Return a planar scan with z = 0: motions in the plane are the same at any height."""
    level = np.array([1.0, 1.0, 0.0])
    return replace(
        scan, points_body=scan.points_body * level.astype(np.float32), origin_body=scan.origin_body * level
    )


def _prepared(scan: Scan, voxel_m: float) -> DeskewedScan:
    return DeskewedScan(scan, prepared(scan.points_body, voxel_m=voxel_m, is_planar=scan.is_planar))
