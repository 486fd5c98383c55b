"""Paper whose tables are measured on sequences of a log."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mapper.core.errors import ConfigError
from mapper.evaluators.papers.measurements import Measurement
from mapper.evaluators.papers.model import PaperPath, PaperTable
from mapper.runtime.resumable_jobs import JobResult


@dataclass(frozen=True, slots=True)
class Cut:
    """Range of the frames that are used of every sequence.

    Attributes:
        first: Index of the first.
        last: Index of the last; None is the log's.
    """

    first: int = 0
    last: int | None = None

    def __post_init__(self) -> None:
        if self.first < 0 or (self.last is not None and self.last < self.first):
            raise ConfigError(f"--first {self.first} --last {self.last}: want 0 ≤ first ≤ last")

    @property
    def is_whole(self) -> bool:
        """Nothing is cut."""
        return self == Cut()

    def __str__(self) -> str:
        return f"{self.first} … {'end' if self.last is None else self.last}"

    def overrides(self, most: int | None = None) -> list[str]:
        """Return the settings that choose these frames; a paper may itself use so many frames at most."""
        ends = [] if self.last is None else [self.last]
        if most is not None:
            ends.append(most - 1)
        return [f"source.first_frame={self.first}", *(f"source.last_frame={end}" for end in sorted(ends)[:1])]


@dataclass(frozen=True, slots=True)
class Paper:
    """A paper.

    Attributes:
        title: Who wrote it, and where.
        sequences: The sequences of each table, by what tables are called on the command line.
        measurements: Returns what is to be measured of a sequence for some tables, with a seed: takes the
            tables, the sequence, its log, the seed, which frames, and a folder for trajectories.
        table_of: Returns a table with the results of all measurements.
        drawn: Returns the trajectories that measurements have left.
    """

    title: str
    sequences: dict[str, list[str]]
    measurements: Callable[[Sequence[str], str, Path, int, Cut, Path], Sequence[Measurement]]
    table_of: Callable[[str, Mapping[Any, JobResult]], PaperTable]
    drawn: Callable[[Sequence[Any]], Sequence[PaperPath]] = lambda _: ()
