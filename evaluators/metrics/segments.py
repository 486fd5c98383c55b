"""Relative errors over segments of the path, as the KITTI odometry benchmark defines them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Array
from mapper.evaluators.metrics.metric import Metric
from mapper.evaluators.metrics.trajectory_errors import Matched, motion_errors, progress_of, statistics
from mapper.evaluators.study.table import Column, Record, degrees, percent

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
EVERY_FRAMES = 10
"""Distance in poses between the beginnings of segments: a second of KITTI's."""

_SHORTER_LENGTHS = 4
_LONGEST_SHARE = 0.5  # of the path: longer segments would all share its middle
_MAX_OVERSHOOT_RATIO = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class LengthErrors:
    """The segments of one length.

    Attributes:
        length_m: Along the true path.
        translation_ratio: (S,) error of each segment's translation, as a share of the length.
        rotation_radpm: (S,) error of its rotation, radians per metre of the length.
    """

    length_m: float
    translation_ratio: Array
    rotation_radpm: Array

    def __len__(self) -> int:
        return len(self.translation_ratio)


def lengths_for(path_m: float) -> tuple[float, ...]:
    """Return the benchmark's lengths for a path that has them all, shorter ones for a shorter path.

    Those are the four longest of 1, 2, 5, 10, 20 … m and their tenths that are at most half the path.

    Args:
        path_m: Length of the true path; none that is known gives no lengths.
    """
    if path_m >= KITTI_LENGTHS_M[-1]:
        return KITTI_LENGTHS_M
    steps = [digit * 10.0**decade for decade in range(-1, 3) for digit in (1, 2, 5)]
    return tuple(round(step, 1) for step in steps if step <= _LONGEST_SHARE * path_m)[-_SHORTER_LENGTHS:]


def segment_errors(matched: Matched, lengths_m: Sequence[float]) -> tuple[LengthErrors, ...]:
    """Return the errors over the segments of each length that the path has (Geiger et al. 2012).

    Every tenth pose begins a segment of each length, which ends at the first pose that lies further along the
    true path. A segment longer than its length by more than a tenth is left out: between the poses of a
    car at 10 Hz there is none, between the keyframes of a walk there may be.

    Args:
        matched: Pairs of poses, at least one; how they are aligned does not matter, their scale does.
        lengths_m: Each > 0; one that the path does not have has no segments.

    Raises:
        DataError: A length is not a positive number.
    """
    if wrong := [length for length in lengths_m if not 0.0 < length < np.inf]:
        raise DataError(f"relative errors over {wrong[0]:g} m: lengths must be > 0")
    along_m = progress_of(matched, "m")
    begins = np.arange(0, len(matched), EVERY_FRAMES)
    found = []
    for length_m in lengths_m:
        ends = np.searchsorted(along_m, along_m[begins] + length_m, side="right")
        i, j = begins[ends < len(along_m)], ends[ends < len(along_m)]
        near = along_m[j] - along_m[i] <= (1.0 + _MAX_OVERSHOOT_RATIO) * length_m
        errors_m, errors_rad = motion_errors(matched, i[near], j[near])
        found.append(LengthErrors(length_m, errors_m / length_m, errors_rad / length_m))
    return tuple(found)


def segment_metrics(errors: Sequence[LengthErrors]) -> list[Metric]:
    """Return the metrics of the segments of all given lengths together; none where there are no segments.

    The means over KITTI's eight lengths are the two numbers of the benchmark's table.
    """
    known = [length for length in errors if len(length)]
    if not known:
        return []
    translation = statistics(np.concatenate([length.translation_ratio for length in known]))
    rotation = statistics(np.concatenate([length.rotation_radpm for length in known]))
    over = "all lengths" if len(errors) > 1 else f"{known[0].length_m:g} m"
    return [
        Metric("segments", sum(map(len, known)), "segments", over),
        Metric("relative translation mean", 100.0 * translation.mean, "%", over),
        Metric("relative translation median", 100.0 * translation.median, "%", over),
        Metric("relative rotation mean", rotation.mean, "rad/m", over),
        Metric("relative rotation median", rotation.median, "rad/m", over),
    ]


_PERCENT, _DEGREES = percent(3), degrees(5)
_FIGURES = ("mean", "median", "max")
LENGTH_COLUMNS = (
    Column("length_m", "segment, m", "{:g}".format),
    Column("segments", "number"),
    *(Column(f"translation_{name}_ratio", f"{name} %", _PERCENT) for name in _FIGURES),
    *(Column(f"rotation_{name}_radpm", f"{name} °/m", _DEGREES) for name in _FIGURES),
)


def length_records(errors: Sequence[LengthErrors]) -> list[Record]:
    """Return a row for each length that has segments, which ``LENGTH_COLUMNS`` show."""
    return [_record(length) for length in errors if len(length)]


def _record(errors: LengthErrors) -> Record:
    translation, rotation = statistics(errors.translation_ratio), statistics(errors.rotation_radpm)
    return {
        "length_m": errors.length_m,
        "segments": len(errors),
        **{f"translation_{name}_ratio": getattr(translation, name) for name in _FIGURES},
        **{f"rotation_{name}_radpm": getattr(rotation, name) for name in _FIGURES},
    }
