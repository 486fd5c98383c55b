"""How a long job tells that it is alive, without knowing who watches."""

from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

Item = TypeVar("Item")


class Progress(Protocol):
    """Whoever watches a job."""

    def over(self, items: Iterable[Item], *, stage: str, total: int) -> Iterator[Item]:
        """Yield the items unchanged, showing how many of the total have passed.

        Args:
            items: What the stage works on.
            stage: What is being done, in a word or two.
            total: How many items are expected.
        """
        ...

    def note(self, message: str) -> None:
        """Tell something worth knowing, in one line."""
        ...


class Silent:
    """Nobody watches."""

    def over(self, items: Iterable[Item], *, stage: str, total: int) -> Iterator[Item]:  # noqa: ARG002
        """Yield the items."""
        yield from items

    def note(self, message: str) -> None:
        """Ignore the message."""


SILENT = Silent()
