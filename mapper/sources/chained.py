"""Several logs as one, in the order in which they were mapped: sessions of one place."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from mapper.core.frames import Frame, Scan, Sensor
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.core.trajectory import Trajectory
from mapper.sources.base import Accelerations, FrameRef, FrameSource, ImageFiles

_PAUSE_NS = NS_PER_S
"""Between one log and the next, where their own stamps do not tell which came first."""


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A log and where it lies on the common clock.

    Attributes:
        log: The log, on its own clock.
        shift_ns: What its stamps are raised by.
        stamps_ns: (N,) its frames on the common clock.
    """

    log: FrameSource
    shift_ns: int
    stamps_ns: Stamps

    def entries(self) -> Iterator[FrameRef]:
        """Yield every frame's entry on the common clock."""
        if not self.shift_ns:
            return self.log.entries()
        return (_Shifted(entry, self.shift_ns) for entry in self.log.entries())


@dataclass(slots=True, eq=False)
class ChainedLog:
    """Sessions one after the other; see :class:`mapper.sources.base.FrameSource`.

    There are no accelerations: two logs' readings may be in different axes. There are no wheels but a single
    session's: each log's are in a frame of their own.
    """

    sessions: Sequence[Session]
    path: Path
    name: str
    kind: str
    truth: Trajectory | None
    notes: Sequence[str]
    sensor: Sensor
    accelerations: Accelerations | None = None
    wheels: Trajectory | None = None

    def __len__(self) -> int:
        return sum(len(session.stamps_ns) for session in self.sessions)

    def entries(self) -> Iterator[FrameRef]:
        """Yield every frame's entry, session by session."""
        for session in self.sessions:
            yield from session.entries()


@dataclass(frozen=True, slots=True)
class _Shifted:
    """An entry on another clock."""

    entry: FrameRef
    shift_ns: int

    @property
    def stamp_ns(self) -> int:
        return self.entry.stamp_ns + self.shift_ns

    @property
    def files(self) -> ImageFiles | None:
        files = self.entry.files
        return files and replace(files, depth_stamp_ns=files.depth_stamp_ns + self.shift_ns)

    def load(self, *, colour: bool = True) -> Frame:
        return replace(self.entry.load(colour=colour), stamp_ns=self.stamp_ns)

    def scan(self) -> Scan:
        return replace(self.entry.scan(), stamp_ns=self.stamp_ns)


def chained(first: FrameSource, second: FrameSource, *, shift_ns: int | None = None) -> ChainedLog:
    """Return a log followed by another.

    Args:
        first: A log, or several chained ones.
        second: The log that comes after.
        shift_ns: What its stamps are raised by. None leaves them as they are if they come after the first
            log's, and otherwise lets it begin one second after the first log's end.
    """
    before = sessions_of(first)
    end_ns, stamps_ns = int(before[-1].stamps_ns[-1]), _stamps(second)
    begin_ns = int(stamps_ns[0])
    if shift_ns is None:
        shift_ns = 0 if begin_ns > end_ns else end_ns + _PAUSE_NS - begin_ns
    return _chain([*before, Session(second, shift_ns, stamps_ns + shift_ns)])


def last_session(source: ChainedLog) -> ChainedLog:
    """Return the last of the logs alone, on the common clock."""
    return _chain(source.sessions[-1:])


def sessions_of(source: FrameSource) -> Sequence[Session]:
    """Return the logs that a source is made of: itself, unless it is chained."""
    if isinstance(source, ChainedLog):
        return source.sessions
    return [Session(source, 0, _stamps(source))]


def _chain(sessions: Sequence[Session]) -> ChainedLog:
    logs = [session.log for session in sessions]
    truth, notes = _truth(sessions)
    notes += [f"{log.name}: {note}" for log in logs for note in log.notes]
    notes += [
        f"{session.log.name}: stamps raised by {session.shift_ns / NS_PER_S:.3f} s, to follow the log before"
        for session in sessions
        if session.shift_ns
    ]
    return ChainedLog(
        sessions=sessions,
        path=logs[0].path,
        name=" + ".join(log.name for log in logs),
        kind=" + ".join(dict.fromkeys(log.kind for log in logs)),
        truth=truth,
        notes=notes,
        sensor=logs[0].sensor,
        wheels=_shifted(logs[0].wheels, sessions[0].shift_ns) if len(logs) == 1 else None,
    )


def _shifted(wheels: Trajectory | None, shift_ns: int) -> Trajectory | None:
    return wheels and replace(wheels, stamps_ns=wheels.stamps_ns + shift_ns)


def _stamps(source: FrameSource) -> Stamps:
    return np.array([entry.stamp_ns for entry in source.entries()], dtype=np.int64)


def _truth(sessions: Sequence[Session]) -> tuple[Trajectory | None, list[str]]:
    """Return the truths one after the other, each until half way to the next session's first frame."""
    bounds_ns = [
        np.iinfo(np.int64).min,
        *((int(a.stamps_ns[-1]) + int(b.stamps_ns[0])) // 2 for a, b in pairwise(sessions)),
        np.iinfo(np.int64).max,
    ]
    told, parts = [], []
    for session, (begin_ns, end_ns) in zip(sessions, pairwise(bounds_ns), strict=True):
        truth = session.log.truth
        if truth is None:
            continue
        stamps_ns = truth.stamps_ns + session.shift_ns
        inside = (stamps_ns > begin_ns) & (stamps_ns <= end_ns)
        if inside.any():
            told.append(session.log.name)
            parts.append((stamps_ns[inside], truth.T_world_body[inside]))
    if not told:
        return None, []
    notes = []
    if len(told) < len(sessions):
        notes.append(f"ground truth of {' and '.join(told)} only")
    if len(told) > 1:
        notes.append(f"the ground truths of {' and '.join(told)} are taken to be in one world")
    return Trajectory(*map(np.concatenate, zip(*parts, strict=True))), notes
