"""Times of a sweep's points, in whatever unit and on whatever clock the sensor's driver wrote them."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S

TIME_FIELDS = (
    "t",  # Ouster: uint32 nanoseconds after the stamp
    "time",  # Velodyne: float32 seconds after or before the stamp
    "timestamp",  # Hesai, RoboSense: float64 seconds of the epoch; Livox: float64 nanoseconds of the epoch
    "timestamps",
    "time_stamp",  # Autoware: uint32 nanoseconds after the stamp
    "offset_time",  # Livox: uint32 nanoseconds after the stamp
    "time_offset",
    "time_offset_ns",
    "point_time",
    "gps_time",  # LAS: float64 seconds, of the GPS week or of the GPS epoch less 10⁹
)
"""Names that drivers give a point's time."""

MAX_SWEEP_S = 2.0
"""No sensor turns slower; points farther apart in time were put together from several sweeps."""

_UNITS_PER_S = (1, 1_000, 1_000_000, NS_PER_S)

_SAME_STEP_RAD, _NEXT_STEP_RAD = 1e-6, 0.1
"""Azimuths of consecutive points of a spinning LiDAR's file: of one column, or of two columns nearby."""
_FEWEST_STEPS, _MIN_ONE_WAY = 100, 0.5
"""Steps, and the share of them in one direction less that in the other: near none in files of another
order."""


def time_field(names: Iterable[str]) -> str | None:
    """Return the first name, in the case it is written in, that drivers give a point's time."""
    return next((name for name in names if name.lower() in TIME_FIELDS), None)


def relative_times_s(values: NDArray[np.number], stamp_ns: int) -> NDArray[np.float32] | None:
    """Return the times of a sweep's points, seconds after its stamp.

    The unit is the coarsest of s, ms, µs and ns in which the sweep lasts at most ``MAX_SWEEP_S``: each is
    a thousand of the next, so it is the right one of every sweep longer than 2 ms. Values within
    ``MAX_SWEEP_S`` of zero are offsets from the stamp already; others within as much of the stamp are times
    on its clock; all others are on a clock of the sensor's own, and the first point is taken at the stamp.

    Args:
        values: (N,) of any integer or floating type, of the points that measured something.
        stamp_ns: Time of the scan, nanoseconds.

    Returns:
        (N,) float32 seconds, negative before the stamp; None where the values are no times: none, all the
        same, not finite, or further apart than a sweep lasts.
    """
    if len(values) == 0:
        return None
    values = np.ascontiguousarray(values)  # faster, for they are read three times
    first, last = values.min(), values.max()  # NaN is the least and the largest of all
    if not (np.isfinite(first) and np.isfinite(last)):
        return None
    span = float(_less(last, first))
    units_per_s = next((unit for unit in _UNITS_PER_S if span <= MAX_SWEEP_S * unit), None)
    if span == 0.0 or units_per_s is None:
        return None
    first_ns = round(first.item() * (NS_PER_S // units_per_s))
    limit_ns = MAX_SWEEP_S * NS_PER_S
    if abs(first_ns) <= limit_ns:
        first_after_stamp_ns = first_ns
    elif abs(first_ns - stamp_ns) <= limit_ns:
        first_after_stamp_ns = first_ns - stamp_ns
    else:
        first_after_stamp_ns = 0
    after_stamp_s = _less(values, first)
    after_stamp_s /= units_per_s
    after_stamp_s += first_after_stamp_ns / NS_PER_S
    return after_stamp_s.astype(np.float32)


def azimuth_times_s(
    points: NDArray[np.floating], origin: Array, sweep_s: float
) -> NDArray[np.float32] | None:
    """Return times after the first point of one turn of a spinning LiDAR, by azimuth; None if none is seen.

    Whether a file lists columns or rings, its points go round in the sensor's direction, and the first was
    measured first.

    Args:
        points: (N, 3) in the order of the file, metres.
        origin: (3,) of the rays; the LiDAR turns about z.
        sweep_s: Duration of a turn.
    """
    if len(points) < 2:
        return None
    azimuth_rad = np.arctan2(points[:, 1] - origin[1], points[:, 0] - origin[0]).astype(np.float64)
    steps_rad = np.remainder(np.diff(azimuth_rad) + np.pi, 2.0 * np.pi) - np.pi
    size_rad = np.abs(steps_rad)
    signs = np.sign(steps_rad[(size_rad > _SAME_STEP_RAD) & (size_rad < _NEXT_STEP_RAD)])
    if len(signs) < _FEWEST_STEPS or abs(one_way := float(signs.mean())) < _MIN_ONE_WAY:
        return None
    turned_rad = np.remainder(np.sign(one_way) * (azimuth_rad - azimuth_rad[0]), 2.0 * np.pi)
    times_s: NDArray[np.float32] = (turned_rad * (sweep_s / (2.0 * np.pi))).astype(np.float32)
    return times_s


def _less(values: NDArray[np.number] | np.number, first: np.number) -> Array:
    """Subtract before rounding: nanoseconds of the epoch do not fit into a float64."""
    wide = values if values.dtype == np.uint64 else values.astype(np.result_type(values, np.int64))
    return np.subtract(wide, first, dtype=wide.dtype).astype(np.float64)
