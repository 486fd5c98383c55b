"""Progress of long jobs: stages, counts and notes."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol, runtime_checkable

Report = Callable[[int, int], None]
"""Takes how many items are done, and how many there will be."""


@runtime_checkable
class Progress(Protocol):
    """Receiver of a job's progress."""

    def stage(self, name: str) -> AbstractContextManager[Report]:
        """Enter a stage of the job, named in a word or two; the result takes its counts."""
        ...

    def note(self, message: str) -> None:
        """Receive a note of one line."""
        ...


class Silent:
    """Receiver that ignores everything."""

    @contextmanager
    def stage(self, name: str) -> Iterator[Report]:  # noqa: ARG002
        """Ignore the stage."""
        yield lambda _done, _total: None

    def note(self, message: str) -> None:
        """Ignore the message."""


SILENT = Silent()
