"""Tables of results: aligned text for a terminal, Markdown for a report, CSV for other programs."""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

Value = str | int | float | None
Record = Mapping[str, Value]
"""One row: name to value, with its unit in the name and every digit in the value; None is not known."""

MISSING = "–"


@dataclass(frozen=True, slots=True)
class Column:
    """A column as it is shown.

    Attributes:
        key: Of the records.
        title: What stands above it, with the unit.
        shown: Turns a value into text.
    """

    key: str
    title: str
    shown: Callable[..., str] = str


def text_table(columns: Sequence[Column], records: Sequence[Record]) -> str:
    """Return aligned lines, two spaces between columns, the first one at the left."""
    rows = [[column.title for column in columns], *_cells(columns, records)]
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
        *_cells(columns, records),
    ]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def csv_text(records: Sequence[Record]) -> str:
    """Return one or more records with every digit, a line each below their names; None is left empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(records[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue()


def _cells(columns: Sequence[Column], records: Sequence[Record]) -> list[list[str]]:
    return [[_cell(column, record[column.key]) for column in columns] for record in records]


def _cell(column: Column, value: Value) -> str:
    return MISSING if value is None else column.shown(value)
