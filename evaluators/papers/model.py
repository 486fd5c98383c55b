"""A paper's table: our measurements beside the printed figures, a line for each or in the printed layout."""

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal

from mapper.evaluators.study.table import Column, Record, Table

Verdict = Literal["better", "as published", "worse", "in part", "failed", "not run", "not printed"]

BETTER_RATIO, SAME_RATIO = 0.95, 1.10
RULE = (
    f"Ratio: the median of ours over the printed figure, less is better. Up to {BETTER_RATIO:.2f} is better, "
    f"up to {SAME_RATIO:.2f} as published, above that worse; failed: no seed gave a figure; in part: "
    "ours is of a part of the log, so there is no ratio."
)
"""The rule of verdicts, for readers."""


@dataclass(frozen=True, slots=True)
class PaperCell:
    """One cell of a printed table. Every figure in the three papers' tables is the better the smaller it is.

    Attributes:
        row: Name of its row as printed, e.g. "fr1/xyz".
        column: Name of its column as printed, e.g. "7", "MP4", "ISVD+LC".
        published: Value as printed; None where the paper has no such cell.
        ours: One per seed, in the table's unit; a method without chance has one. Empty if every try failed.
        failures: Why the other seeds gave nothing, a line each.
        in_part: Ours is of a part of what the printed figure is of, so the two do not compare.
    """

    row: str
    column: str
    published: float | None
    ours: tuple[float, ...]
    failures: tuple[str, ...] = ()
    in_part: bool = False

    @property
    def median(self) -> float | None:
        """Median over our seeds."""
        return median(self.ours) if self.ours else None

    @property
    def low(self) -> float | None:
        """Least figure of our seeds."""
        return min(self.ours, default=None)

    @property
    def high(self) -> float | None:
        """Largest figure of our seeds."""
        return max(self.ours, default=None)

    @property
    def ratio(self) -> float | None:
        """Our median over the printed figure, where the two compare."""
        if not self.ours or not self.published or self.in_part:
            return None
        return median(self.ours) / self.published

    @property
    def verdict(self) -> Verdict:
        """Verdict by the ratio: up to 0.95 better, up to 1.10 as published, else worse.

        Without a ratio: "failed" if all seeds did, "not run" if nothing was tried, as where the log is the
        author's own, "in part" if ours is of a part of the log, and "not printed" if there is nothing to
        compare with.
        """
        if not self.ours:
            return "failed" if self.failures else "not run"
        if self.ratio is None:
            return "in part" if self.in_part and self.published else "not printed"
        if self.ratio <= BETTER_RATIO:
            return "better"
        return "as published" if self.ratio <= SAME_RATIO else "worse"


@dataclass(frozen=True, slots=True)
class PaperTable:
    """A printed table, as far as its logs were at hand.

    Attributes:
        name: "Table 5.1".
        title: Its content, in a line.
        source: Source of the table, from ``published.json``.
        metric: "ATE RMSE"; what is printed in the cells.
        unit: "m"; empty where it differs by column, whose text then ends in its own, e.g. "x [mm]".
        cells: Row by row.
        axis: Quantity of the columns, e.g. "iterations" or "MP", if they are numbers that make a curve.
        notes: Sentences that a reader must know to compare: other hardware, another log, a part of it.
    """

    name: str
    title: str
    source: str
    metric: str
    unit: str
    cells: tuple[PaperCell, ...]
    axis: str = ""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PaperPath:
    """A trajectory to be drawn, in files.

    Attributes:
        row: The sequence, e.g. "fr1/xyz".
        method: "ISVD+LC".
        ate_m: ATE RMSE in metres, SE(3)-aligned.
        estimate: TUM file, already aligned with the truth.
        truth: TUM file.
    """

    row: str
    method: str
    ate_m: float
    estimate: Path
    truth: Path


@dataclass(frozen=True, slots=True)
class Reproduction:
    """A paper's tables measured again, and what is shown with them.

    Attributes:
        paper: Author, title, year.
        tables: Tables in the paper's order.
        paths: Trajectories to draw.
        missing: The paper's sequences that are not at hand.
        seeds: Number of seeds where chance plays a part.
        notes: Sentences that hold for all tables, e.g. "first 200 frames only".
        pictures: PNG files that were drawn while the tables were measured.
    """

    paper: str
    tables: tuple[PaperTable, ...]
    paths: tuple[PaperPath, ...] = ()
    missing: tuple[str, ...] = ()
    seeds: int = 1
    notes: tuple[str, ...] = ()
    pictures: tuple[Path, ...] = ()


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
