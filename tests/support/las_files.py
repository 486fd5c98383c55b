"""LAS files of a LiDAR's scans, written by laspy with the times of their points (LAS 1.4, ASPRS 2019)."""

from collections.abc import Iterable
from pathlib import Path

import laspy
import numpy as np

from mapper.core.frames import Scan

WEEK_S = 604_800
ADJUSTED_S = 1_000_000_000
GPS_EPOCH_S = 315_964_800
LEAP_S = 18
"""GPS time is ahead of UTC since 2017."""


def gps_s(unix_ns: int) -> float:
    """Return GPS time, seconds since 1980-01-06, of Unix time."""
    return unix_ns / 1e9 - GPS_EPOCH_S + LEAP_S


def write_las(
    path: Path,
    scans: Iterable[Scan],
    *,
    is_dated: bool = True,
    shift_s: float = 0.0,
    moved=lambda scan: scan.points_body,
    by_time: bool = True,
) -> Path:
    """Write the points of scans in the order of their times.

    Args:
        path: File; ".laz" compresses.
        scans: With times of their points.
        is_dated: Times are GPS time less 10⁹ s; else seconds of the GPS week.
        shift_s: Added to the times.
        moved: Returns (N, 3) points of a scan.
        by_time: Else the last comes first.
    """
    scans = list(scans)
    points = np.concatenate([moved(scan) for scan in scans]).astype(np.float64)
    times_s = np.concatenate([gps_s(scan.stamp_ns) + scan.times_s.astype(np.float64) for scan in scans])
    order = np.argsort(times_s, kind="stable")[:: 1 if by_time else -1]
    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales = np.full(3, 1e-4)
    header.offsets = np.floor(points.min(axis=0))
    times_s += shift_s
    if is_dated:
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
        times_s -= ADJUSTED_S
    else:
        times_s %= WEEK_S
    cloud = laspy.LasData(header)
    cloud.xyz = points[order]
    cloud.gps_time = times_s[order]
    path.parent.mkdir(parents=True, exist_ok=True)
    cloud.write(str(path))
    return path
