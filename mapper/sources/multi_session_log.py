"""Several logs as one, in the order in which they were mapped: sessions of one place."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate, pairwise

import numpy as np

from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Positions, Trajectory
from mapper.sensing.gyroscope import Gyroscope
from mapper.sources.base import FrameRef, Log, Session, later

_PAUSE_NS = NS_PER_S
"""Time between two logs whose own stamps are not in order."""


def chained(first: Log, second: Log, *, shift_ns: int | None = None) -> Log:
    """Return a log followed by another.

    The chain has the angular velocities of gyroscopes that are calibrated, which are the body's. It has no
    accelerations, for two logs' may be in different axes, no wheel odometry, for each log's is in a frame
    of its own, and no GNSS fixes. Its ``sessions`` keep all of it.

    Args:
        first: A log, or several chained ones.
        second: The log that comes after.
        shift_ns: Nanoseconds to add to the second log's stamps. None leaves them as they are if they come
            after the first log's, and otherwise lets it begin one second after the first log's end.
    """
    end_ns, begin_ns = int(first.stamps_ns[-1]), int(second.stamps_ns[0])
    if shift_ns is None:
        shift_ns = 0 if begin_ns > end_ns else end_ns + _PAUSE_NS - begin_ns
    sessions = (*sessions_of(first), Session(shifted(second, shift_ns), shift_ns))
    logs = [session.log for session in sessions]
    truth, notes = _joined_truth(logs)
    notes += [f"{log.name}: {note}" for log in logs for note in log.notes]
    notes += [
        f"{session.log.name}: stamps raised by {session.shift_ns / NS_PER_S:.3f} s, to follow the log before"
        for session in sessions
        if session.shift_ns
    ]
    notes += [
        f"{log.name}: GNSS fixes that are not used; those of the first session place the map"
        for log in logs[1:]
        if log.gnss is not None
    ]
    starts = [0, *accumulate(map(len, logs))]

    def entry_at(index: int) -> FrameRef:
        number = bisect_right(starts, index) - 1
        return logs[number].entry_at(index - starts[number])

    return Log(
        path=logs[0].path,
        name=" + ".join(log.name for log in logs),
        kind=" + ".join(dict.fromkeys(log.kind for log in logs)),
        sensor=logs[0].sensor,
        stamps_ns=np.concatenate([log.stamps_ns for log in logs]),
        entry_at=entry_at,
        truth=truth,
        gyroscope=_joined_gyroscope(logs),
        images=[images for log in logs for images in log.images],
        beside=[sensor for log in logs for sensor in log.beside],
        T_base_body=logs[0].T_base_body,
        T_body_base=logs[0].T_body_base,
        base_frame=logs[0].base_frame,
        base_height_m=logs[0].base_height_m,
        body_frame=logs[0].body_frame,
        sensors=logs[0].sensors,
        choices=[f"{log.name}: {choice}" for log in logs for choice in log.choices],
        notes=notes,
        sessions=sessions,
    )


def sessions_of(log: Log) -> Sequence[Session]:
    """Return the logs that a log is made of: itself, unless it is chained."""
    return log.sessions or (Session(log, 0),)


def shifted(log: Log, shift_ns: int) -> Log:
    """Return a log on a clock that is ahead of its own."""
    if not shift_ns:
        return log

    def entry_at(index: int) -> FrameRef:
        entry = log.entry_at(index)
        stamp_ns = entry.stamp_ns + shift_ns
        return replace(
            entry,
            stamp_ns=stamp_ns,
            read=lambda colour: replace(entry.read(colour), stamp_ns=stamp_ns),
            returns=lambda: replace(entry.scan(), stamp_ns=stamp_ns),
        )

    return replace(
        log,
        stamps_ns=log.stamps_ns + shift_ns,
        entry_at=entry_at,
        truth=later(log.truth, shift_ns),
        device_poses=later(log.device_poses, shift_ns),
        T_body_base=replace(log.T_body_base, stamps_ns=log.T_body_base.stamps_ns + shift_ns),
        wheels=later(log.wheels, shift_ns),
        accelerations=later(log.accelerations, shift_ns),
        gyroscope=later(log.gyroscope, shift_ns),
        gnss=later(log.gnss, shift_ns),
        images=[replace(one, stamps_ns=one.stamps_ns + shift_ns) for one in log.images],
        beside=[replace(one, log=shifted(one.log, shift_ns)) for one in log.beside],
    )


def _joined_gyroscope(logs: Sequence[Log]) -> Gyroscope | None:
    """Return the body's angular velocities of all logs that have them, each log's until the next begins."""
    parts = []
    for log, (begin_ns, end_ns) in zip(logs, _spans_ns(logs), strict=True):
        gyroscope = log.gyroscope
        if gyroscope is not None and gyroscope.is_of_body:
            inside = (gyroscope.stamps_ns > begin_ns) & (gyroscope.stamps_ns <= end_ns)
            parts.append((gyroscope.name, gyroscope.stamps_ns[inside], gyroscope.rates_radps[inside]))
    if not parts:
        return None
    names, stamps_ns, rates = zip(*parts, strict=True)
    name = " + ".join(dict.fromkeys(names))
    return Gyroscope(name, np.concatenate(stamps_ns), np.concatenate(rates), np.eye(3), is_of_body=True)


def _spans_ns(logs: Sequence[Log]) -> list[tuple[int, int]]:
    """Return the time of each log: from half way to the frames before it to half way to those after it."""
    bounds_ns = [
        np.iinfo(np.int64).min,
        *((int(a.stamps_ns[-1]) + int(b.stamps_ns[0])) // 2 for a, b in pairwise(logs)),
        np.iinfo(np.int64).max,
    ]
    return list(pairwise(bounds_ns))


def _joined_truth(logs: Sequence[Log]) -> tuple[Trajectory | None, list[str]]:
    """Return the truths one after the other, each until half way to the next log's first frame."""
    named, parts = [], []
    for log, (begin_ns, end_ns) in zip(logs, _spans_ns(logs), strict=True):
        if log.truth is None:
            continue
        stamps_ns = log.truth.stamps_ns
        inside = (stamps_ns > begin_ns) & (stamps_ns <= end_ns)
        if inside.any():
            named.append(log.name)
            parts.append((stamps_ns[inside], log.truth.T_world_body[inside]))
    if not named:
        return None, []
    notes = []
    if len(named) < len(logs):
        notes.append(f"ground truth of {' and '.join(named)} only")
    if len(named) > 1:
        notes.append(f"the ground truths of {' and '.join(named)} are taken to be in one world")
    kind = Positions if any(isinstance(log.truth, Positions) for log in logs) else Trajectory
    stamps_ns, T_world_body = map(np.concatenate, zip(*parts, strict=True))
    return kind(stamps_ns, T_world_body), notes
