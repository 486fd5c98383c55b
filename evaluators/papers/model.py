"""Model of a paper's table: our measurements beside the printed figures."""

from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal

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
