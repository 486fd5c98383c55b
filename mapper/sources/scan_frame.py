"""Plausibility of a LiDAR's scans: their frame, the sensor's or a map's, and how long their sweeps last."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise

import numpy as np

from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S
from mapper.sources.base import FrameRef, Log

_LOOKED_AT_AT_FIRST, _LOOKED_AT = 3, 6
"""Scans, spread over the log; six are read where three show that the middle of what is seen moves, and points
behind others."""
_DIRECTION_RAD = np.radians(1.0)
_BEHIND_RATIO, _BEHIND_M = 1.3, 0.3
"""A point is behind another in its direction if it is farther by this ratio; neighbours on a wall are not."""
_MOST_BEHIND = 0.1
"""Share of the points behind others as seen from their origin: up to 0.07 among trees; where the sensor is
metres off the origin 0.1 to 0.4 in streets and rooms, less in fields, tunnels and thin clouds."""
_FEWER_BEHIND = 1.5
"""Ratio of the shares as seen from the origin and from where the points' middle is: around the sensor at most
1.3, in a map that begins at the sensor 1.4 to 30, where the sensor is metres off."""
_MOVED_M = 0.5
_STAYED_SHARE = 0.2
"""Scans lie in a map if surfaces move by less than this share of the way of the scans' middle."""
_VOXEL_M, _PAIR_DISTANCES_M = 0.3, (1.0, 0.5)
_CONSECUTIVE = 7
"""Scans at both ends that are compared where the first ones repeat: six pairs, for twos and threes."""
_MOST_PERIODS = 3.5
"""Periods of the scans that a sweep lasts at most: three where as many LiDARs share a topic."""


def scan_frame_warnings(log: Log) -> list[str]:
    """Return that scans seem to be in the coordinates of a map and not around the sensor; few are read.

    From where it stands a sensor sees one surface in each direction, so that no point lies behind another. In
    a map surfaces stay at the same coordinates while what is seen of them moves on with the sensor.
    """
    if log.sensor != "lidar":
        return []
    for most, share_of in ((_LOOKED_AT_AT_FIRST, max), (_LOOKED_AT, np.median)):
        scans = list(_readable(log.spread_entries(most)))
        ways_m = [float(np.linalg.norm(_middle_way(one, other))) for one, other in pairwise(scans)]
        if not any(way_m > _MOVED_M for way_m in ways_m):
            return []
        behind = [_share_behind(scan, scan.origin_body) for scan in scans]
        if share_of(behind) <= _MOST_BEHIND and not _is_seen_from_the_middle(scans, behind):
            return []
    moved = [k for k, way_m in enumerate(ways_m) if way_m > _MOVED_M]
    stayed = [k for k in moved if _surfaces_way_m(scans[k], scans[k + 1]) < _STAYED_SHARE * ways_m[k]]
    if len(stayed) < 2 or 2 * len(stayed) < len(moved):
        return []
    return [
        f"scans: surfaces stay at the same coordinates while the middle of what is seen moves by "
        f"{sum(ways_m[k] for k in stayed):.1f} m, and {np.median(behind):.0%} of the points lie behind "
        "others as seen from their origin; are they in the frame of a map and not around the sensor? map the "
        "driver's own clouds"
    ]


def sweep_warnings(log: Log) -> list[str]:
    """Return what is implausible about the times of scans and of their points, a sentence each; few are read.

    Points may have times of more than the time between scans, as columns or shares of a turn; and scans may
    come at several stamps each.
    """
    if log.sensor == "rgbd" or len(log) < 2:
        return []
    warnings = []
    period_s = float(np.median(np.diff(log.stamps_ns))) / NS_PER_S
    scans = list(_readable(log[:_LOOKED_AT_AT_FIRST].entries()))
    sweeps_s = [float(np.ptp(scan.times_s)) for scan in scans if scan.times_s is not None]
    sweep_s = float(np.median(sweeps_s)) if sweeps_s else 0.0
    if sweep_s > _MOST_PERIODS * period_s:
        warnings.append(
            f"times of points: a sweep lasts {sweep_s:.3g} s, but scans come every {period_s:.3g} s; are "
            f"they shares of a turn, or columns? source.point_time_scale={period_s / sweep_s:.3g} makes a "
            "sweep as long as that, 0 leaves its times out"
        )
    if not any(_repeats(log[:_LOOKED_AT_AT_FIRST])):
        return warnings
    parts = [_repeats(log[:_CONSECUTIVE]), _repeats(log[-_CONSECUTIVE:])]
    if all(any(part) and not all(part) for part in parts):
        again, pairs = sum(map(sum, parts)), sum(map(len, parts))
        stride = max(round(pairs / (pairs - again)), 2)
        warnings.append(
            f"scans: {again} of {pairs} looked at have the points of the one before at another stamp: the "
            f"LiDAR is slower than its stamps; source.stride={stride} takes each once"
        )
    return warnings


def _repeats(log: Log) -> list[bool]:
    """Return whether each scan after the first has the points of the one before."""
    sums = [scan.checksum for scan in _readable(log.entries())]
    return [one == other for one, other in pairwise(sums)]


def _readable(entries: Iterable[FrameRef]) -> Iterator[Scan]:
    """Yield the scans that can be read and have points."""
    for entry in entries:
        try:
            scan = entry.scan()
        except FrameError:
            continue
        if len(scan.points_body):
            yield scan


def _is_seen_from_the_middle(scans: Sequence[Scan], behind: Sequence[float]) -> bool:
    """Return whether fewer points lie behind others as seen from where the points' middle has moved to.

    A map may begin where the sensor stood; then few points of thin clouds lie behind others for long.
    """
    from_middle = [_share_behind(scan, scan.origin_body + _middle_way(scans[0], scan)) for scan in scans[1:]]
    return sum(behind[1:]) > _FEWER_BEHIND * sum(from_middle)


def _share_behind(scan: Scan, origin_body: Array) -> float:
    """Return the share of the points that lie behind another one, seen from a place."""
    offsets = scan.points_body - origin_body
    ranges_m = np.linalg.norm(offsets, axis=1)
    offsets, ranges_m = offsets[ranges_m > _BEHIND_M], ranges_m[ranges_m > _BEHIND_M]
    if not len(ranges_m):
        return 0.0
    azimuth = np.arctan2(offsets[:, 1], offsets[:, 0]) + np.pi
    elevation = np.arcsin(np.clip(offsets[:, 2] / ranges_m, -1.0, 1.0)) + 0.5 * np.pi
    columns, rows = (np.floor(angle / _DIRECTION_RAD).astype(np.intp) for angle in (azimuth, elevation))
    directions = columns * (rows.max() + 1) + rows
    nearest_m = np.full(directions.max() + 1, np.inf)
    np.minimum.at(nearest_m, directions, ranges_m)
    return float((ranges_m > _BEHIND_RATIO * nearest_m[directions] + _BEHIND_M).mean())


def _middle_way(one: Scan, other: Scan) -> Array:
    """Return the (3,) way from the median of one scan's points to that of another's, metres."""
    way: Array = np.median(other.points_body, axis=0) - np.median(one.points_body, axis=0)
    return way


def _surfaces_way_m(one: Scan, other: Scan) -> float:
    """Return how far surfaces have moved from one scan to another; infinity where that is not found."""
    from mapper.registration.pair_refinement import refine
    from mapper.registration.surfaces import prepared

    target, source = (prepared(scan.points_body, voxel_m=_VOXEL_M) for scan in (one, other))
    found = refine(target, source, np.eye(4), kind="plane-icp", pair_distances_m=_PAIR_DISTANCES_M)
    return float(np.linalg.norm(found.T_target_source[:3, 3])) if found.converged else np.inf
