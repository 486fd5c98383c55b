"""Logs whose frames lie in memory."""

from dataclasses import dataclass, replace
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


class CountedReads:
    """A log that counts how often its frames are read, and of which some cannot be."""

    def __init__(self, source, damaged=()):
        self.damaged, self.reads = damaged, []
        self.log = replace(source, entry_at=lambda index: CountedEntry(self, index, source.entry_at(index)))


class CountedEntry(EntryWithoutFiles):
    def __init__(self, counted, index, entry):
        self.counted, self.index, self.entry, self.stamp_ns = counted, index, entry, entry.stamp_ns

    def load(self, *, colour=True):
        self.counted.reads.append(self.index)
        if self.index in self.counted.damaged:
            raise FrameError(f"frame {self.index}: damaged")
        return self.entry.load(colour=colour)
