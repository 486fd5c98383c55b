"""The part of a log that is used: a range of frames, a stride, and frames with truth only."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import SourceError
from mapper.core.frames import Sensor
from mapper.core.timebase import NS_PER_S, nearest
from mapper.core.trajectory import Trajectory
from mapper.sources.base import Accelerations, FrameRef, FrameSource
from mapper.sources.config import SourceConfig


@dataclass(slots=True, eq=False)
class Selection:
    """A log of which only some frames are used; see :class:`mapper.sources.base.FrameSource`."""

    path: Path
    name: str
    kind: str
    sensor: Sensor
    truth: Trajectory | None
    accelerations: Accelerations | None
    wheels: Trajectory | None
    notes: Sequence[str]
    source: FrameSource
    is_used: NDArray[np.bool_]

    def __len__(self) -> int:
        return int(self.is_used.sum())

    def entries(self) -> Iterator[FrameRef]:
        """Yield the entries in use, in time order."""
        return compress(self.source.entries(), self.is_used)


def select(source: FrameSource, config: SourceConfig) -> FrameSource:
    """Return the frames ``first_frame`` … ``last_frame`` by ``stride``, with truth where it is required.

    Raises:
        SourceError: Nothing is left, or truth is required of a log that has none.
    """
    total = len(source)
    stop = total if config.last_frame is None else config.last_frame + 1
    is_used = np.zeros(total, dtype=bool)
    is_used[config.first_frame : stop : config.stride] = True
    if not is_used.any():
        last = "end" if config.last_frame is None else config.last_frame
        raise SourceError(
            f"{source.path}: no frame is left of the range {config.first_frame} … {last}; "
            f"the log has {total} frames, 0 … {total - 1}"
        )
    notes = list(source.notes)
    if config.require_truth:
        has_truth = _has_truth(source, max_gap_s=config.max_truth_gap_s)
        dropped = int((is_used & ~has_truth).sum())
        is_used &= has_truth
        within = f"within {config.max_truth_gap_s * 1e3:g} ms"
        if not is_used.any():
            raise SourceError(f"{source.path}: no selected frame has ground truth {within}")
        if dropped:
            notes.append(f"{dropped} frames have no ground truth {within}; left out")
    if is_used.all():
        return source
    notes.append(f"{int(is_used.sum())} of {total} frames selected")
    return Selection(
        path=source.path,
        name=source.name,
        kind=source.kind,
        sensor=source.sensor,
        truth=source.truth,
        accelerations=source.accelerations,
        wheels=source.wheels,
        notes=notes,
        source=source,
        is_used=is_used,
    )


def _has_truth(source: FrameSource, *, max_gap_s: float) -> NDArray[np.bool_]:
    if source.truth is None:
        raise SourceError(
            f"{source.path}: ground truth is required (source.require_truth), but the log has none"
        )
    stamps_ns = np.array([entry.stamp_ns for entry in source.entries()], dtype=np.int64)
    _, gap_ns = nearest(source.truth.stamps_ns, stamps_ns)
    return gap_ns <= round(max_gap_s * NS_PER_S)
