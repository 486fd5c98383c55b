"""Scans of several LiDARs on one body, merged by time into one."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.errors import FrameError
from mapper.core.frames import Frame, Scan
from mapper.core.geometry import Transform, apply
from mapper.core.timebase import NS_PER_S, nearest
from mapper.sources.base import FrameRef, Log, WrappedEntry


@dataclass(frozen=True, slots=True)
class _MergedEntry(WrappedEntry):
    """An entry whose scan has the points of other LiDARs' scans, too, each at its own time.

    Attributes:
        others: Their entries, and the poses T_body_other of their bodies.
    """

    others: Sequence[tuple[FrameRef, Transform]]

    def load(self, *, colour: bool = True) -> Frame:
        scans = [self.entry.load(colour=colour).scan()]
        for entry, T_body_other in self.others:
            with suppress(FrameError):  # fusing reports it
                scan = entry.scan()
                points_body = apply(T_body_other, scan.points_body.astype(np.float64)).astype(np.float32)
                scans.append(replace(scan, points_body=points_body))
        return _merged(scans)

    def scan(self) -> Scan:
        return self.load(colour=False).scan()


def with_merged_scans(log: Log) -> Log:
    """Return a 3D LiDAR's log whose scans have the points of the 3D LiDARs beside it, each at its own time.

    Each of their scans is in the one that is nearest in time, if that is at most half a period away. Rays
    begin at the first sensor, so the log is for tracking; maps are fused from each sensor's own scans.
    """
    beside = [one for one in log.beside if one.log.sensor == "lidar" and len(one.log)]
    if log.sensor != "lidar" or not beside or len(log) < 2:
        return log
    others: list[list[tuple[FrameRef, Transform]]] = [[] for _ in range(len(log))]
    for one in beside:
        stamps_ns = one.log.stamps_ns
        nearest_of, gap_ns = nearest(log.stamps_ns, stamps_ns)
        for index in np.unique(nearest_of).tolist():
            candidates = np.flatnonzero(nearest_of == index)
            best = int(candidates[gap_ns[candidates].argmin()])
            if gap_ns[best] <= 0.5 * np.median(np.diff(log.stamps_ns)):
                others[index].append((one.log.entry_at(best), one.T_body_sensor))
    return replace(log, entry_at=lambda index: _MergedEntry(log.entry_at(index), others[index]))


def _merged(scans: Sequence[Scan]) -> Scan:
    first_ns = scans[0].stamp_ns
    apart_s = [(scan.stamp_ns - first_ns) / NS_PER_S for scan in scans]
    times_s = [
        np.zeros(len(scan.points_body), np.float32) if scan.times_s is None else scan.times_s
        for scan in scans
    ]
    return replace(
        scans[0],
        points_body=np.concatenate([scan.points_body for scan in scans]),
        times_s=np.concatenate([own_s + np.float32(s) for own_s, s in zip(times_s, apart_s, strict=True)]),
        colors=None,
        intensities=None,
        far_returns=sum(scan.far_returns for scan in scans),
        untimed_returns=sum(scan.untimed_returns for scan in scans),
    )
