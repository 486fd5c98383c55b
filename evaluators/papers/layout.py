"""Layouts of a paper's table: a line for each comparison, or as printed with our lines below theirs."""

import math
import re
from collections import Counter
from collections.abc import Sequence
from statistics import median

from mapper.evaluators.papers.model import PaperCell, PaperTable, Reproduction
from mapper.evaluators.tables.table import Column, Record, Table

_DIGITS = 3
"""Significant digits of figures without a printed one beside them."""


def compares(table: PaperTable) -> bool:
    """Return whether any figure of ours is compared with a printed one."""
    return any(cell.published is not None and (cell.ours or cell.failures) for cell in table.cells)


def headline(table: PaperTable) -> str:
    """Return a table's name, title and quantity, in a line."""
    quantity = ", ".join(filter(None, (table.metric, table.unit)))
    return "; ".join(filter(None, (f"{table.name}: {table.title}", quantity)))


def compared(table: PaperTable) -> Table:
    """Return a line for each figure: printed, ours, its spread over the seeds, ratio and verdict."""
    decimals = _decimals(table)
    records: list[Record] = [
        {
            "row": cell.row,
            "column": cell.column,
            **_figures(cell, decimals[cell.column]),
            "verdict": cell.verdict,
            "failures": len(cell.failures) or None,
        }
        for cell in table.cells
    ]
    always = {"row": "", "column": table.axis, "printed": "printed", "ours": "ours"}
    often = {"spread": "spread", "ratio": "ratio", "verdict": "verdict", "failures": "failed"}
    shown = {key: title for key, title in often.items() if any(record[key] is not None for record in records)}
    return Table([Column(key, title) for key, title in {**always, **shown}.items()], records)


def as_printed(table: PaperTable, *, with_spread: bool) -> Table:
    """Return the printed layout, where a row's figures, ours, their range and the ratios are lines.

    Args:
        table: The table.
        with_spread: Whether the lowest and the highest of several seeds are shown.
    """
    decimals = _decimals(table)
    records: list[Record] = []
    for row in dict.fromkeys(cell.row for cell in table.cells):
        figures = {
            cell.column: _figures(cell, decimals[cell.column]) for cell in table.cells if cell.row == row
        }
        name = row
        for line in ("printed", "ours", *(("lowest", "highest") if with_spread else ()), "ratio"):
            texts = {column: of_cell[line] for column, of_cell in figures.items()}
            if any(texts.values()):
                records.append({"row": name, "line": line, **dict.fromkeys(decimals), **texts})
                name = ""
    head = [Column("row", "")]
    if len({record["line"] for record in records}) > 1:
        head.append(Column("line", ""))
    return Table([*head, *(Column(column, column) for column in decimals)], records)


def everything(reproduction: Reproduction) -> list[Record]:
    """Return every cell of every table with all its digits."""
    return [
        {
            "paper": reproduction.paper,
            "table": table.name,
            "row": cell.row,
            "column": cell.column,
            "metric": table.metric,
            "unit": table.unit,
            "published": cell.published,
            "ours_median": cell.median,
            "ours_low": cell.low,
            "ours_high": cell.high,
            "seeds": len(cell.ours),
            "ratio": cell.ratio,
            "verdict": cell.verdict,
            "failures": "; ".join(cell.failures),
        }
        for table in reproduction.tables
        for cell in table.cells
    ]


def counted(table: PaperTable) -> str:
    """Return how often each verdict was given, in a line."""
    verdicts = Counter(cell.verdict for cell in table.cells)
    return ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items())


def failures(table: PaperTable) -> list[str]:
    """Return why figures are missing, a line for each reason and the cells it holds for."""
    where: dict[str, list[str]] = {}
    for cell in table.cells:
        for reason in cell.failures:
            where.setdefault(reason, []).append(f"{cell.row}, {cell.column}")
    return [
        f"{cells[0]}{f' (and {len(cells) - 1} more)' if len(cells) > 1 else ''}: {reason}"
        for reason, cells in where.items()
    ]


def file_name(name: str) -> str:
    """Return a name as a file's, without its ending."""
    return re.sub(r"[^\w.-]+", "_", name)


def _decimals(table: PaperTable) -> dict[str, int]:
    """Return how many decimals each column has: as usual in it, or in a table that has one unit."""
    of_column: dict[str, list[PaperCell]] = {}
    for cell in table.cells:
        of_column.setdefault(cell.column, []).append(cell)
    least = _usual_decimals(table.cells) if table.unit else 0
    return {column: max(_usual_decimals(cells), least) for column, cells in of_column.items()}


def _usual_decimals(cells: Sequence[PaperCell]) -> int:
    """Return as many as most of the printed figures have, or enough for a few digits of ours."""
    printed = Counter(_own_decimals(cell.published) for cell in cells if cell.published is not None)
    if printed:
        return printed.most_common(1)[0][0]
    typical = median([abs(figure) for cell in cells for figure in cell.ours] or [0.0])
    return max(_DIGITS - 1 - math.floor(math.log10(typical)), 0) if typical else 0


def _own_decimals(figure: float) -> int:
    return len(f"{figure:.6f}".rstrip("0").partition(".")[2])


def _figures(cell: PaperCell, decimals: int) -> dict[str, str | None]:
    """Return what is shown of a cell; a printed figure keeps all its digits, and ours has as many."""
    printed = None
    if cell.published is not None:
        decimals = max(decimals, _own_decimals(cell.published))
        printed = f"{cell.published:.{decimals}f}"
    lowest = highest = spread = None
    if len(cell.ours) > 1:
        lowest, highest = f"{cell.low:.{decimals}f}", f"{cell.high:.{decimals}f}"
        spread = f"{lowest}–{highest}"
    return {
        "printed": printed,
        "ours": None if cell.median is None else f"{cell.median:.{decimals}f}",
        "lowest": lowest,
        "highest": highest,
        "spread": spread,
        "ratio": None if cell.ratio is None else f"{cell.ratio:.2f}",
    }
