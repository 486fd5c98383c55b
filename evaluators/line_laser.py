"""How well a line-laser sensor sees: its stripe by every method, and ranges as in the thesis's Table 2.1."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evaluators.tables import Column, Record
from mapper.config.line_laser import StripeConfig
from mapper.errors import SourceError
from mapper.frames import Image
from mapper.geometry import Array
from mapper.sensing.line_laser.detection import METHODS, Method, Response, responses, stripe_rows
from mapper.sources.text import parse_numbers, rows

TABLE_2_1: Mapping[float, float] = {0.5: 0.50, 1.0: 0.99, 1.5: 1.45, 1.7: 1.65}
"""Metres: what was true, and what the thesis's sensor measured."""

TOLERANCE_PX = 3.0
"""A pixel within this distance of the stripe's true middle shows the stripe."""

_NEAR_M = 0.1


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f}"


DETECTION_COLUMNS = (
    Column("method", "method"),
    Column("precision", "precision %", _percent),
    Column("recall", "recall %", _percent),
    Column("f_score", "F %", _percent),
    Column("pixel_precision", "pixels' precision %", _percent),
    Column("pixel_recall", "pixels' recall %", _percent),
    Column("pixel_f_score", "pixels' F %", _percent),
)
RANGE_COLUMNS = (
    Column("range_m", "range m"),
    Column("columns", "columns"),
    Column("median_error_ratio", "median error %", _percent),
    Column("p90_error_ratio", "90th percentile %", _percent),
    Column("thesis_error_ratio", "thesis %", _percent),
)


@dataclass(frozen=True, slots=True)
class Counts:
    """What a method found in some images; counts of several images add up.

    Attributes:
        stripe_columns: Columns with a stripe.
        marked: Pixels the method kept.
        right: Those of them that show the stripe.
        reached: Columns whose stripe has such a pixel.
        rows: Columns for which the method gives one row.
        right_rows: Those of them whose row is the stripe's.
    """

    stripe_columns: int = 0
    marked: int = 0
    right: int = 0
    reached: int = 0
    rows: int = 0
    right_rows: int = 0

    def __add__(self, other: "Counts") -> "Counts":
        return Counts(
            self.stripe_columns + other.stripe_columns,
            self.marked + other.marked,
            self.right + other.right,
            self.reached + other.reached,
            self.rows + other.rows,
            self.right_rows + other.right_rows,
        )

    @property
    def pixels(self) -> tuple[float, float, float]:
        """Precision, recall and F of the pixels: what share is right, what share of the stripe they reach."""
        return _scores(self.right, self.marked, self.reached, self.stripe_columns)

    @property
    def columns(self) -> tuple[float, float, float]:
        """Precision, recall and F of the one row that each column gives."""
        return _scores(self.right_rows, self.rows, self.right_rows, self.stripe_columns)


def count(response: Response, true_rows: Array, *, join_px: int) -> Counts:
    """Return what a method's (H, W) response says of (W,) true rows, NaN where there is no stripe."""
    found = stripe_rows(response, join_px=join_px)
    near = np.abs(np.arange(len(response))[:, None] - true_rows) <= TOLERANCE_PX  # False where NaN
    right = (response > 0) & near
    return Counts(
        stripe_columns=int(np.isfinite(true_rows).sum()),
        marked=int(np.count_nonzero(response)),
        right=int(right.sum()),
        reached=int(right.any(axis=0).sum()),
        rows=int(np.isfinite(found).sum()),
        right_rows=int((np.abs(found - true_rows) <= TOLERANCE_PX).sum()),
    )


def count_all(image: Image, true_rows: Array, config: StripeConfig) -> dict[Method, Counts]:
    """Return what every method finds in an (H, W, 3) RGB image with its (W,) true rows."""
    return {
        method: count(response, true_rows, join_px=config.join_px)
        for method, response in responses(image, config).items()
    }


def summed(counts: Iterable[Mapping[Method, Counts]]) -> dict[Method, Counts]:
    """Return the counts of several images together."""
    total = dict.fromkeys(METHODS, Counts())
    for one in counts:
        total = {method: total[method] + one[method] for method in METHODS}
    return total


def detection_records(counts: Mapping[Method, Counts]) -> list[Record]:
    """Return one record for each method."""
    return [
        {"method": method}
        | dict(zip(("precision", "recall", "f_score"), found.columns, strict=True))
        | dict(zip(("pixel_precision", "pixel_recall", "pixel_f_score"), found.pixels, strict=True))
        for method, found in counts.items()
    ]


def range_records(true_m: Array, found_m: Array) -> list[Record]:
    """Return one record for each range of Table 2.1, from the columns that are truly as far within 10 cm.

    Args:
        true_m: (N,) where the stripe was.
        found_m: (N,) where it was measured.
    """
    records: list[Record] = []
    for range_m, published_m in TABLE_2_1.items():
        near = np.abs(true_m - range_m) <= _NEAR_M
        errors = np.abs(found_m[near] - true_m[near]) / true_m[near]
        records.append(
            {
                "range_m": range_m,
                "columns": int(near.sum()),
                "median_error_ratio": float(np.median(errors)) if near.any() else None,
                "p90_error_ratio": float(np.percentile(errors, 90)) if near.any() else None,
                "thesis_error_ratio": abs(published_m - range_m) / range_m,
            }
        )
    return records


def read_labels(path: Path, *, width_px: int) -> dict[str, tuple[Array, Array]]:
    """Return (W,) true rows and (W,) true ranges, NaN where there is no stripe, by the name of the image.

    Args:
        path: Lines ``image,column,row_px,range_m``; an image without a stripe has none.
        width_px: W.

    Raises:
        SourceError: The file is missing or malformed.
    """
    labels: dict[str, tuple[Array, Array]] = {}
    for number, words in rows(path, separator=","):
        where = f"{path}:{number}"
        if words[0] == "image":
            continue
        if len(words) != 4:
            raise SourceError(f"{where}: {len(words)} columns, want 4: image,column,row_px,range_m")
        column, row_px, range_m = parse_numbers(words[1:], where=where)
        if not (0.0 <= column < width_px and column == int(column)):
            raise SourceError(f"{where}: column {words[1]}, want a whole number from 0 to {width_px - 1}")
        if words[0] not in labels:
            labels[words[0]] = (np.full(width_px, np.nan), np.full(width_px, np.nan))
        true_rows, ranges_m = labels[words[0]]
        true_rows[int(column)], ranges_m[int(column)] = row_px, range_m
    if not labels:
        raise SourceError(f"{path}: no labels; want lines of image,column,row_px,range_m")
    return labels


def _scores(right: int, found: int, reached: int, wanted: int) -> tuple[float, float, float]:
    precision, recall = right / max(found, 1), reached / max(wanted, 1)
    return precision, recall, 2.0 * precision * recall / max(precision + recall, 1e-12)
