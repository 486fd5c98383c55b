"""Scores of the methods that find a laser's stripe in images with known stripes."""

from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass
from operator import add

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Image
from mapper.core.geometry import Array
from mapper.evaluators.tables.table import Column, Table, decimals
from mapper.line_laser.config import StripeConfig
from mapper.line_laser.detection import METHODS, Method, Response, responses, stripe_rows

TABLE_2_1: Mapping[float, float] = {0.5: 0.50, 1.0: 0.99, 1.5: 1.45, 1.7: 1.65}
"""True ranges in metres, and what the sensor of Somlyai (PhD thesis, Table 2.1) measured there."""

TOLERANCE_PX = 3.0
"""A pixel within this distance of the stripe's true middle shows the stripe."""


PERCENT = decimals(1, times=100.0)
"""Shows a share."""

_COLUMNS = (
    Column("method", "method"),
    Column("precision", "precision %", PERCENT),
    Column("recall", "recall %", PERCENT),
    Column("f_score", "F %", PERCENT),
    Column("pixel_precision", "pixels' precision %", PERCENT),
    Column("pixel_recall", "pixels' recall %", PERCENT),
    Column("pixel_f_score", "pixels' F %", PERCENT),
)


@dataclass(frozen=True, slots=True)
class Counts:
    """Counts of a method's detections in some images; those of several images add up.

    Attributes:
        stripe_columns: Columns with a stripe.
        marked: Number of pixels that the method kept.
        right: Number of these that show the stripe.
        reached: Columns whose stripe has such a pixel.
        rows: Columns for which the method gives one row.
        right_rows: Number of these whose row is the stripe's.
    """

    stripe_columns: int = 0
    marked: int = 0
    right: int = 0
    reached: int = 0
    rows: int = 0
    right_rows: int = 0

    def __add__(self, other: "Counts") -> "Counts":
        return Counts(*map(add, astuple(self), astuple(other)))

    @property
    def pixels(self) -> tuple[float, float, float]:
        """Precision, recall and F of the pixels: what share is right, what share of the stripe they reach."""
        return _scores(self.right, self.marked, self.reached, self.stripe_columns)

    @property
    def columns(self) -> tuple[float, float, float]:
        """Precision, recall and F of the one row that each column gives."""
        return _scores(self.right_rows, self.rows, self.right_rows, self.stripe_columns)


def count(response: Response, true_rows: Array, *, join_px: int) -> Counts:
    """Return the counts of a method's (H, W) response by (W,) true rows, NaN where there is no stripe."""
    found = stripe_rows(response, join_px=join_px)
    right = (response > 0) & is_right(np.arange(float(len(response)))[:, None], true_rows)
    return Counts(
        stripe_columns=int(np.isfinite(true_rows).sum()),
        marked=int(np.count_nonzero(response)),
        right=int(right.sum()),
        reached=int(right.any(axis=0).sum()),
        rows=int(np.isfinite(found).sum()),
        right_rows=int(is_right(found, true_rows).sum()),
    )


def count_all(image: Image, true_rows: Array, config: StripeConfig) -> dict[Method, Counts]:
    """Return the counts of every method in an (H, W, 3) RGB image with its (W,) true rows."""
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


def is_right(found: Array, true_rows: Array) -> NDArray[np.bool_]:
    """Return in which of (W,) columns the row that was found is the stripe's."""
    return np.abs(found - true_rows) <= TOLERANCE_PX  # False where NaN


def detection_table(counts: Mapping[Method, Counts]) -> Table:
    """Return one record for each method."""
    records = [
        {"method": method}
        | dict(zip(("precision", "recall", "f_score"), found.columns, strict=True))
        | dict(zip(("pixel_precision", "pixel_recall", "pixel_f_score"), found.pixels, strict=True))
        for method, found in counts.items()
    ]
    return Table(_COLUMNS, records)


def _scores(right: int, found: int, reached: int, wanted: int) -> tuple[float, float, float]:
    precision, recall = right / max(found, 1), reached / max(wanted, 1)
    return precision, recall, 2.0 * precision * recall / max(precision + recall, 1e-12)
