"""Scores of the methods that find a laser's stripe in images with known stripes, and of its ranges."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from operator import add
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import SourceError
from mapper.core.frames import Image
from mapper.core.geometry import Array
from mapper.evaluators.study.table import Column, Record, Table, csv_text, percent
from mapper.line_laser.config import StripeConfig
from mapper.line_laser.detection import METHODS, Method, Response, responses, stripe_rows
from mapper.line_laser.files import DETECTIONS, RANGE_ERRORS
from mapper.line_laser.ranging import LineScan
from mapper.runtime.atomic import write_text
from mapper.sources.image_files.reading import read_colour
from mapper.sources.text import parse_numbers, rows

TABLE_2_1: Mapping[float, float] = {0.5: 0.50, 1.0: 0.99, 1.5: 1.45, 1.7: 1.65}
"""True ranges in metres, and what the sensor of Somlyai (PhD thesis, Table 2.1) measured there."""

TOLERANCE_PX = 3.0
"""A pixel within this distance of the stripe's true middle shows the stripe."""


PERCENT = percent(1)
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


_NEAR_M = 0.1

_RANGE_COLUMNS = (
    Column("range_m", "range m"),
    Column("columns", "columns"),
    Column("median_error_ratio", "median error %", PERCENT),
    Column("p90_error_ratio", "90th percentile %", PERCENT),
    Column("thesis_error_ratio", "thesis %", PERCENT),
)


@dataclass(frozen=True, slots=True, eq=False)
class LabelScores:
    """Detections and ranges of a sensor in labelled images.

    Attributes:
        images: Number of images.
        counts: Counts of every method's detections.
        true_m: (N,) ranges in all columns in which a stripe was and was found.
        found_m: (N,) what was measured there.
    """

    images: int
    counts: Mapping[Method, Counts]
    true_m: Array
    found_m: Array

    @property
    def text(self) -> str:
        """Both tables, for a terminal."""
        return f"{self._detections.text()}\n\n{self._ranges.text()}"

    def write(self, folder: Path) -> None:
        """Write both tables as ``detections.csv`` and ``range_errors.csv``."""
        write_text(folder / DETECTIONS, csv_text(self._detections.records))
        write_text(folder / RANGE_ERRORS, csv_text(self._ranges.records))

    @property
    def _detections(self) -> Table:
        return detection_table(self.counts)

    @property
    def _ranges(self) -> Table:
        return Table(_RANGE_COLUMNS, range_records(self.true_m, self.found_m))


def score(
    scans: Mapping[Path, LineScan], labels: Mapping[str, tuple[Array, Array]], config: StripeConfig
) -> LabelScores:
    """Return the scores of scans whose images have labels; the others do not count.

    Args:
        scans: Scans by the names of their images.
        labels: Labels from :func:`read_labels`.
        config: Settings of the stripe detection.

    Raises:
        FrameError: An image can no longer be read.
    """
    labelled = {path: scan for path, scan in scans.items() if path.name in labels}
    counts = summed(count_all(read_colour(path), labels[path.name][0], config) for path in labelled)
    true_m = np.concatenate([labels[path.name][1][scan.columns] for path, scan in labelled.items()])
    found_m = np.concatenate([scan.points_sensor[:, 0] for scan in labelled.values()])
    both = np.isfinite(true_m)
    return LabelScores(len(labelled), counts, true_m[both], found_m[both])


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


def read_labels(path: Path, *, images: Sequence[Path], width_px: int) -> dict[str, tuple[Array, Array]]:
    """Return (W,) true rows and (W,) true ranges, NaN where there is no stripe, by the name of the image.

    Args:
        path: Lines ``image,column,row_px,range_m``; an image without a stripe has none.
        images: Images, at least one of which has labels.
        width_px: W.

    Raises:
        SourceError: The file is missing or malformed, or is of other images.
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
    if labels.keys().isdisjoint(image.name for image in images):
        raise SourceError(
            f"{path}: of {next(iter(labels))} and others, but images are {images[0].name} and others: "
            "none has labels; do the names agree?"
        )
    return labels
