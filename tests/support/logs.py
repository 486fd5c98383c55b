"""Logs whose frames lie in memory."""

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mapper.core.errors import FrameError
from mapper.sources.base import FrameRef, Log


def memory_entry(stamp_ns: int, frame: Any, *, depth_delay_ns: int = 0) -> FrameRef:
    """An entry without files; ``frame`` may be an error to raise."""

    def read(_colour: bool) -> Any:
        if isinstance(frame, Exception):
            raise frame
        return frame

    return FrameRef(stamp_ns, read, depth_delay_ns=depth_delay_ns)


def log_in_memory(entries: list[FrameRef], *, name: str = "memory", **facts: Any) -> Log:
    """An RGB-D log of some entries; ``facts`` are other fields of it."""
    return Log(
        path=Path(name),
        name=name,
        kind="memory",
        stamps_ns=np.array([entry.stamp_ns for entry in entries], np.int64),
        entry_at=entries.__getitem__,
        **({"sensor": "rgbd"} | facts),
    )


def changed_frames(log: Log, change: Callable[[int, Any], Any]) -> Log:
    """A log whose frames are what ``change`` makes of their numbers and of them; it may raise."""

    def entry_at(index: int) -> FrameRef:
        entry = log.entry_at(index)
        return FrameRef(entry.stamp_ns, lambda colour: change(index, entry.read(colour)))

    return replace(log, entry_at=entry_at)


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
