"""Progress that is kept, and that can stop a job."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Stopped(KeyboardInterrupt):
    """Ctrl-C at a certain item."""


class Observer:
    """Keeps notes and counts, and stops a job at a count of a stage.

    Attributes:
        notes: What it was told.
        reached: The last count of each stage and its total, by the stage's name.
        counts: All counts of all stages.
    """

    def __init__(self, stage: str = "", count: int = 0) -> None:
        self.notes: list[str] = []
        self.reached: dict[str, tuple[int, int]] = {}
        self.counts: list[tuple[int, int]] = []
        self._stop = stage, count

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[[int, int], None]]:
        def report(done: int, total: int) -> None:
            self.reached[name] = done, total
            self.counts.append((done, total))
            if (name, done) == self._stop:
                raise Stopped

        yield report

    def note(self, message: str) -> None:
        self.notes.append(message)
