"""Logs whose frames lie in memory."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mapper.core.errors import FrameError
from mapper.sources.base import FrameRef, Log


class EntryWithoutFiles:
    """Part of entries whose whole frame was measured at the stamp."""

    @property
    def depth_stamp_ns(self: FrameRef) -> int:
        return self.stamp_ns

    @property
    def files(self) -> None:
        return None


@dataclass(frozen=True)
class MemoryEntry(EntryWithoutFiles):
    """An entry without files; ``frame`` may be an error to raise."""

    stamp_ns: int
    frame: Any

    def load(self, *, colour: bool = True) -> Any:  # noqa: ARG002
        if isinstance(self.frame, Exception):
            raise self.frame
        return self.frame

    def scan(self) -> Any:
        return self.load().scan()


def log_in_memory(entries: list[MemoryEntry], *, name: str = "memory", **facts: Any) -> Log:
    """An RGB-D log of some entries; ``facts`` are other fields of it."""
    return Log(
        path=Path(name),
        name=name,
        kind="memory",
        stamps_ns=np.array([entry.stamp_ns for entry in entries], np.int64),
        entry_at=entries.__getitem__,
        **({"sensor": "rgbd"} | facts),
    )


@dataclass(frozen=True)
class ChangedEntry(EntryWithoutFiles):
    """An entry whose frame is changed as it is read."""

    entry: FrameRef
    change: Callable[[Any], Any]

    @property
    def stamp_ns(self) -> int:
        return self.entry.stamp_ns

    def load(self, *, colour: bool = True) -> Any:
        return self.change(self.entry.load(colour=colour))

    def scan(self) -> Any:
        return self.load().scan()


def changed_frames(log: Log, change: Callable[[int, Any], Any]) -> Log:
    """A log whose frames are what ``change`` makes of their numbers and of them; it may raise."""
    return replace(log, entry_at=lambda i: ChangedEntry(log.entry_at(i), partial(change, i)))


class CountedReads:
    """A log that counts how often its frames are read, and of which some cannot be."""

    def __init__(self, source: Log, damaged: Collection[int] = ()) -> None:
        self.damaged, self.reads = damaged, list[int]()
        self.log = changed_frames(source, self._read)

    def _read(self, index: int, frame: Any) -> Any:
        self.reads.append(index)
        if index in self.damaged:
            raise FrameError(f"frame {index}: damaged")
        return frame
