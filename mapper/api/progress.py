"""Progress as callers receive it: an object, or a function of lines of text."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mapper.core.errors import ConfigError
from mapper.runtime.progress import SILENT, Progress, Report

AnyProgress = Progress | Callable[[str], object] | None
"""A receiver of progress, a function that is called with lines of text, such as ``print``, or silence."""


def receiver_of(progress: AnyProgress) -> Progress:
    """Return the receiver that a caller means.

    Raises:
        ConfigError: It is none.
    """
    if progress is None:
        return SILENT
    if isinstance(progress, Progress):
        return progress
    if callable(progress):
        return _Lines(progress)
    raise ConfigError(f"progress: {progress!r} is no function of a line; want print, or None for silence")


class _Lines:
    """Progress as lines of text, one at the beginning of each stage, each tenth of it, and each note."""

    def __init__(self, write: Callable[[str], object]) -> None:
        self._write = write

    @contextmanager
    def stage(self, name: str) -> Iterator[Report]:
        """Write the stage's name, and then its tenths."""
        written = 0
        self._write(name)

        def report(done: int, total: int) -> None:
            nonlocal written
            tenth = 10 * done // max(total, 1)
            if tenth > written:
                written = tenth
                self._write(f"{name} {done}/{total}")

        yield report

    def note(self, message: str) -> None:
        """Write the note."""
        self._write(message)
