"""Scans merged by time into one: of several LiDARs on one body, or parts of a turn of one."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.core.geometry import Transform, stride_for
from mapper.core.timebase import NS_PER_S, nearest
from mapper.sources.base import FrameRef, Log

_LOOKED_AT, _FEWEST_PARTS, _MOST_DIRECTIONS = 16, 8, 2000
_WIDEST_PART_RAD = 1.5 * np.pi
_LONGEST_TURN_NS = NS_PER_S // 4
"""LiDARs turn 5 to 20 times a second; what turns them (a pan unit) is slower, and its tf is known."""
_LEAST_TURNED_RAD, _SAME_RATE, _MIN_USUAL = 1e-3, 0.25, 0.75
"""Rates of turning that count as the same, and the share of them: scenes are empty on one side and not on
another, and packets are lost."""


def _merged_entry(entry: FrameRef, others: Sequence[tuple[FrameRef, Transform | None]]) -> FrameRef:
    """Return an entry whose scan has the points of other LiDARs' scans, too, each at its own time.

    Args:
        entry: The entry.
        others: Their entries, and the poses T_body_other of their bodies; None of the same body.
    """

    def read(colour: bool) -> Scan:
        scans = [entry.read(colour).scan()]
        for other, T_body_other in others:
            if T_body_other is None:
                scans.append(other.read(colour).scan())
                continue
            with suppress(FrameError):  # fusing reports it
                scans.append(other.read(colour).scan().moved(T_body_other))
        return _merged(scans)

    return replace(entry, read=read, returns=None)


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
    return replace(log, entry_at=lambda index: _merged_entry(log.entry_at(index), others[index]))


def with_whole_turns(log: Log) -> Log:
    """Return a spinning LiDAR's log whose scans are whole turns where parts of turns were published.

    Parts are clouds of less than three quarters of a turn, each as far round from the one before as the time
    between them says. A turn has the stamp of its first part.
    """
    turn_ns = _turn_of_parts_ns(log) if log.sensor == "lidar" and len(log) > _FEWEST_PARTS else None
    if turn_ns is None:
        return log
    turns = (log.stamps_ns - log.stamps_ns[0] + int(np.median(np.diff(log.stamps_ns))) // 2) // turn_ns
    begins = np.flatnonzero(np.diff(turns, prepend=-1))
    ends = np.append(begins[1:], len(log))

    def entry_at(index: int) -> FrameRef:
        first, *others = (log.entry_at(k) for k in range(begins[index], ends[index]))
        return _merged_entry(first, [(one, None) for one in others])

    note = (
        f"the {len(log)} clouds are parts of turns: {np.median(ends - begins):.0f} of them are joined to "
        f"each of {len(begins)} scans of {turn_ns / NS_PER_S:.3g} s"
    )
    return replace(log, stamps_ns=log.stamps_ns[begins], entry_at=entry_at, notes=[*log.notes, note])


def _turn_of_parts_ns(log: Log) -> int | None:
    """Return the duration of a turn of whose parts the first clouds are; None if they are none."""
    parts = []
    for index in range(min(len(log), _LOOKED_AT)):
        entry = log.entry_at(index)
        with suppress(FrameError):
            scan = entry.scan()
            few = scan.points_body[:: stride_for(len(scan.points_body), _MOST_DIRECTIONS)]
            if len(few) == 0:  # the sky
                continue
            x, y = (few[:, :2] - scan.origin_body[:2]).T.astype(np.float64)
            direction = (x + 1j * y) / np.maximum(np.hypot(x, y), 1e-9)
            middle = direction.sum()
            if np.ptp(np.angle(direction * middle.conj())) > _WIDEST_PART_RAD:
                return None
            parts.append((entry.stamp_ns, middle))
    if len(parts) < _FEWEST_PARTS:
        return None
    stamps_ns, middles = (np.array(one) for one in zip(*parts, strict=True))
    turned_rad = np.abs(np.angle(middles[1:] * middles[:-1].conj()))
    turns_ns = 2.0 * np.pi * np.diff(stamps_ns) / np.maximum(turned_rad, _LEAST_TURNED_RAD)
    turn_ns = float(np.median(turns_ns))
    is_usual = np.abs(turns_ns / turn_ns - 1.0) < _SAME_RATE
    if turn_ns > _LONGEST_TURN_NS or is_usual.mean() < _MIN_USUAL:
        return None
    part_ns = float(np.median(np.diff(log.stamps_ns)))
    return round(max(round(turn_ns / part_ns), 1) * part_ns)


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
        colors=_joined([scan.colors for scan in scans]),
        intensities=_joined([scan.intensities for scan in scans]),
        far_returns=sum(scan.far_returns for scan in scans),
        untimed_returns=sum(scan.untimed_returns for scan in scans),
    )


def _joined(parts: Sequence[NDArray[Any] | None]) -> NDArray[Any] | None:
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if len(known) == len(parts) else None
