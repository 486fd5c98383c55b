"""Tables of results: text for a terminal, Markdown and LaTeX for a report, CSV and Parquet for programs."""

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill

import numpy as np

from mapper.core.errors import LINE_WIDTH
from mapper.core.geometry import Array
from mapper.runtime.atomic import atomic_file
from mapper.runtime.extras import extra

Value = str | int | float | None
Record = Mapping[str, Value]
"""One row: name to value, with its unit in the name and every digit in the value; None is not known."""

MISSING = "–"

_LATEX = {
    **{character: f"\\{character}" for character in "&%$#_{}"},
    **{character: f"${character}$" for character in "<>|"},
    **{character: f"{{{character}}}" for character in "[]*"},  # after a line's end these are its options
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    '"': "''",
    "–": "--",
    "…": r"\ldots{}",
    "“": "``",
    "”": "''",
    "’": "'",
    "°": r"$^\circ$",
    "≥": r"$\geq$",
    "≤": r"$\leq$",
    "±": r"$\pm$",
    "×": r"$\times$",
    "→": r"$\rightarrow$",
    "−": "$-$",
    "·": r"$\cdot$",
}


@dataclass(frozen=True, slots=True)
class Column:
    """A column as it is shown.

    Attributes:
        key: Key in the records.
        title: Heading with the unit.
        shown: Turns a value into text.
    """

    key: str
    title: str
    shown: Callable[..., str] = str


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Records as they are shown, with what must be known to read them.

    Attributes:
        columns: Columns that are shown of each record.
        records: A row each.
        title: Headline in a document.
        notes: A sentence each.
    """

    columns: Sequence[Column]
    records: Sequence[Record]
    title: str = ""
    notes: Sequence[str] = ()

    def text(self) -> str:
        """Return aligned lines for a terminal, with the notes indented below."""
        return "\n".join([text_table(self.columns, self.records), *indented(self.notes)])

    def markdown(self) -> str:
        """Return the table under its headline, with the notes as a list."""
        parts = [f"## {self.title}", markdown_table(self.columns, self.records)]
        return "\n\n".join([*parts, *([markdown_list(self.notes)] if self.notes else [])])


def decimals(count: int, *, times: float = 1.0) -> Callable[[float], str]:
    """Return what shows a number, in another unit if it is multiplied, with a number of decimals."""
    return lambda value: f"{times * value:.{count}f}"


def percent(count: int) -> Callable[[float], str]:
    """Return what shows a share in per cent."""
    return decimals(count, times=100.0)


def degrees(count: int) -> Callable[[float], str]:
    """Return what shows radians in degrees."""
    return decimals(count, times=math.degrees(1.0))


def indented(notes: Sequence[str]) -> list[str]:
    """Return sentences as they stand below a table on a terminal."""
    return [fill(note, LINE_WIDTH, initial_indent="  ", subsequent_indent="    ") for note in notes]


def markdown_list(lines: Sequence[str]) -> str:
    """Return a Markdown list."""
    return "\n".join(f"- {line}" for line in lines)


def column(records: Sequence[Record], key: str) -> Array:
    """Return (N,) the numbers of one name in all records, NaN where they are not known."""
    return np.array([record[key] for record in records], dtype=np.float64)


def text_table(columns: Sequence[Column], records: Sequence[Record]) -> str:
    """Return aligned lines, two spaces between columns, the first one at the left."""
    rows = [[column.title for column in columns], *shown_cells(columns, records)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if k == 0 else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


def markdown_table(columns: Sequence[Column], records: Sequence[Record]) -> str:
    """Return a Markdown table."""
    rows = [
        [column.title for column in columns],
        ["---" if k == 0 else "---:" for k in range(len(columns))],
        *shown_cells(columns, records),
    ]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in rows)


def latex_table(columns: Sequence[Column], records: Sequence[Record]) -> str:
    """Return a LaTeX ``tabular`` in the style of booktabs, whose package it needs."""
    head, *rows = (
        " & ".join(map(latex_text, row)) + r" \\"
        for row in ([column.title for column in columns], *shown_cells(columns, records))
    )
    alignment = "l" + "r" * (len(columns) - 1)
    lines = [rf"\begin{{tabular}}{{{alignment}}}", r"\toprule", head, r"\midrule", *rows, r"\bottomrule"]
    return "\n".join([*lines, r"\end{tabular}"])


def latex_text(text: str) -> str:
    """Return plain text as LaTeX prints it; letters with accents need no more than UTF-8, its default."""
    return "".join(_LATEX.get(character, character) for character in text)


def csv_text(records: Sequence[Record]) -> str:
    """Return one or more records with every digit, a line each below their names; None is left empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(records[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue()


def shown_cells(columns: Sequence[Column], records: Sequence[Record]) -> list[list[str]]:
    """Return what stands in the cells of every record."""
    return [[_cell(column, record[column.key]) for column in columns] for record in records]


def _cell(column: Column, value: Value) -> str:
    return MISSING if value is None else column.shown(value)


def write_parquet(path: Path, records: Sequence[Record]) -> None:
    """Write records, whole or not at all: text, whole numbers and numbers as columns of their type.

    A column without any value is one of numbers.

    Args:
        path: File to write.
        records: One or more, all with the first one's names.
    """
    with extra("study", path.name):
        import pyarrow as pa  # takes a second
        from pyarrow import parquet

    table = pa.Table.from_pylist(list(records))
    fields = [one.with_type(pa.float64()) if pa.types.is_null(one.type) else one for one in table.schema]
    with atomic_file(path) as part:
        parquet.write_table(table.cast(pa.schema(fields)), part)
