"""Measured points, in metres around the sensor, from the columns of a cloud file."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError
from mapper.core.frames import Points32
from mapper.sources.cloud_files.parsing import MAX_RANGE_M, MIN_POINTS, SAMPLES, Column, Columns
from mapper.sources.point_times import time_field

_INTENSITY_FIELDS = ("intensity", "reflectivity", "reflectance", "scalar_intensity")
"""Names of drivers, of CloudCompare, and of LAS."""
_AWAY_RATIO = 10.0  # times the cloud's own size, and it cannot be a sweep around its origin


@dataclass(frozen=True, slots=True, eq=False)
class RawCloud:
    """Measured points of a cloud file.

    Attributes:
        points: (N, 3) float32, metres, sensor frame.
        names: Fields of the file.
        times: (N,) each point's time as the file has it; ``field_times_s`` finds unit and clock.
        colors: (N, 3) uint8 RGB.
        intensities: (N,) float32.
    """

    points: Points32
    names: tuple[str, ...]
    times: Column | None
    colors: NDArray[np.uint8] | None
    intensities: NDArray[np.float32] | None


def cloud_from(columns: Columns, *, path: Path, scale: float | None) -> RawCloud:
    """Return the cloud of a file's columns; not a number, infinity and 0 0 0 are missing returns.

    Args:
        columns: Columns that were read; x, y and z are needed.
        path: The file, for messages.
        scale: Metres per unit; None is 1, and checked.

    Raises:
        FrameError: No coordinates, too few measured points, or points not in metres around the sensor.
    """
    columns = {name.lower(): values for name, values in columns.items()}
    if not {"x", "y", "z"} <= columns.keys():
        raise FrameError(f"{path}: fields {' '.join(columns) or 'none'}; want x y z among them")
    points = np.empty((len(columns["x"]), 3), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, name in enumerate("xyz"):
            points[:, axis] = columns[name] if scale is None else columns[name] * scale
    is_measured = _measured(points)
    total, measured = len(points), int(is_measured.sum())
    if measured < MIN_POINTS:
        raise FrameError(f"{path}: {measured} of {total} points measured anything; want {MIN_POINTS} or more")
    field = time_field(columns)
    times = None if field is None else columns[field]
    colors = _colors(columns)
    field = intensity_field(columns)
    intensities = None if field is None else intensities_of(columns[field])
    if measured < total:
        points = points.compress(is_measured, axis=0)  # three times as fast as an index
        times = None if times is None else times[is_measured]
        colors = None if colors is None else colors.compress(is_measured, axis=0)
        intensities = None if intensities is None else intensities.compress(is_measured)
    check_range(points, where=f"{path}", is_scaled=scale is not None)
    return RawCloud(points, tuple(columns), times, colors, intensities)


def intensity_field(names: Iterable[str]) -> str | None:
    """Return the first name, in the case it is written in, that drivers give a point's intensity."""
    return next((name for name in names if name.lower() in _INTENSITY_FIELDS), None)


def intensities_of(values: Column) -> NDArray[np.float32] | None:
    """Return (N,) intensities, 0 where not finite; None where all are 0, as in files without any."""
    if values.dtype.kind not in "fiu":
        return None
    intensities = np.nan_to_num(values.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    return intensities if intensities.any() else None


def _measured(points: Points32) -> NDArray[np.bool_]:
    x, y, z = points.T
    with np.errstate(over="ignore", invalid="ignore"):  # infinities of both signs
        finite = np.isfinite(x + y + z)
    measured: NDArray[np.bool_] = finite & ((x != 0.0) | (y != 0.0) | (z != 0.0))
    return measured


def check_range(points: Points32, *, where: str, is_scaled: bool) -> None:
    """Refuse points that are not metres around the sensor.

    Args:
        points: (N, 3) as recorded, or scaled.
        where: Name of the cloud in an error.
        is_scaled: Whether the user set a unit.

    Raises:
        FrameError: A twentieth of them are farther than sensors reach.
    """
    if not len(points):
        return
    sample = points[:: 1 + len(points) // SAMPLES].astype(np.float64)
    range_m = np.percentile(np.linalg.norm(sample, axis=1), 95)
    if range_m <= MAX_RANGE_M:
        return
    size_m = np.percentile(np.linalg.norm(sample - np.median(sample, axis=0), axis=1), 95)
    if range_m > _AWAY_RATIO * size_m:
        raise FrameError(
            f"{where}: points {size_m:.3g} m around a place {range_m:.0f} m away from the origin; "
            "want them around the sensor: subtract a common offset before single precision rounds them"
        )
    if not is_scaled:
        raise FrameError(
            f"{where}: 5 % of the points are farther than {range_m:.0f} m, which looks like millimetres; "
            "--set source.cloud_scale=0.001, or 1 if these are metres, 0.01 if centimetres"
        )


def _colors(columns: Columns) -> NDArray[np.uint8] | None:
    packed = columns.get("rgb", columns.get("rgba"))
    if packed is not None and packed.dtype.itemsize == 4:
        bits = packed.view(np.uint32)
        return np.stack([bits >> 16, bits >> 8, bits], axis=1).astype(np.uint8)
    if not {"red", "green", "blue"} <= columns.keys():
        return None
    channels = np.stack([columns["red"], columns["green"], columns["blue"]], axis=1)
    return _as_bytes(channels)


def _as_bytes(channels: NDArray[np.number[Any]]) -> NDArray[np.uint8]:
    """Return colours of 8 bits: LAS has 16, unless its writer left the upper ones empty; floats end at 1."""
    top = channels.max(initial=0)
    if np.issubdtype(channels.dtype, np.floating) and top <= 1.0:
        channels = channels * 255.0
    elif top > 255:
        channels = channels / 257.0
    colors: NDArray[np.uint8] = np.nan_to_num(channels).round().clip(0, 255).astype(np.uint8)
    return colors
