"""The documents: README.md and the pages, their blocks of commands, and what they claim that is printed."""

import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.support.paths import ROOT

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
OMITTED = "…"
"""A line for those that a page leaves out."""

_BLOCK = re.compile(r"^<!-- run(?:: ([^>]*?))? -->\n```(console|python)\n(.*?)^```", re.DOTALL | re.MULTILINE)
_FILE = re.compile(r"^<!-- file: (\S+) -->\n```\w+\n(.*?)^```", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Command:
    """A command of a console block.

    Attributes:
        text: The line after the prompt.
        shown: The lines that the page shows as its output.
    """

    text: str
    shown: Sequence[str]

    @property
    def words(self) -> list[str]:
        """The words of the line; the first is the program."""
        return shlex.split(self.text)


@dataclass(frozen=True, slots=True)
class Block:
    """A block that is run.

    Attributes:
        kind: "console" or "python".
        marks: The words of its mark, such as "free rows".
        text: What stands in it.
        start: Where its text begins in the page.
    """

    kind: str
    marks: frozenset[str]
    text: str
    start: int

    @property
    def commands(self) -> list[Command]:
        """The commands of a console block, in order."""
        parts = re.split(r"^\$ ", self.text, flags=re.MULTILINE)[1:]
        lines = (part.partition("\n") for part in parts)
        return [Command(command, output.splitlines()) for command, _, output in lines]


def blocks_of(page: str) -> Iterator[Block]:
    """Yield the blocks of a page that are run, in order."""
    for found in _BLOCK.finditer(page):
        marks = frozenset(mark.strip() for mark in (found[1] or "").split(","))
        yield Block(found[2], marks, found[3], found.start(3))


def files_of(page: str) -> dict[str, str]:
    """Return the files that a page shows, by their names."""
    return dict(_FILE.findall(page))


def row_names(lines: Sequence[str]) -> list[str]:
    """Return the first column of a table: what stands before two spaces; lines that go on have none."""
    return [re.split(r"\s{2,}", line)[0] for line in lines if line and not line.startswith(" ")]


def omits_rows_of(shown: Sequence[str], printed: Sequence[str]) -> bool:
    """Tell whether what is shown has the rows of what is printed, but for those that are omitted."""
    pieces: list[list[str]] = [[]]
    for name in row_names(shown):
        if name == OMITTED:
            pieces.append([])
        else:
            pieces[-1].append(name)
    rest = row_names(printed)
    first, *others = pieces
    if rest[: len(first)] != first or (not others and rest != first):
        return False
    rest = rest[len(first) :]
    for piece in others[:-1]:
        at = next((i for i in range(len(rest)) if rest[i : i + len(piece)] == piece), None)
        if at is None:
            return False
        rest = rest[at + len(piece) :]
    return not others or not others[-1] or rest[-len(others[-1]) :] == others[-1]


def page_name(path: Path) -> str:
    """Return a page's path in the repository."""
    return str(path.relative_to(ROOT))
