"""Times of a sweep's points, in whatever unit and on whatever clock the sensor's driver wrote them."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Scan
from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S, UNITS_PER_S

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

_LIKE_TIME = re.compile(r"time|stamp|^(?:d?t|t_?offset)(?:_?[num]?s)?$", re.IGNORECASE)
"""Other names of times, whose values must increase from point to point as times do."""
_MOST_BACK = 0.02
"""Share of the steps from point to point that go back to an earlier column: each ring's first, if at all."""
_MOST_IN_FLOAT32 = 1e6
"""Seconds of which float32 tells a sixteenth."""
_UNIT_NAMES = dict(zip(UNITS_PER_S, ("seconds", "milliseconds", "microseconds", "nanoseconds"), strict=True))

MAX_SWEEP_S = 2.0
"""No sensor turns slower; points farther apart in time were put together from several sweeps."""

LEAST_SHARE = 0.5
"""Share of the usual number of points or packets that a sweep must have: the first and the last are cut."""
_USUAL_SWEEP_NS = NS_PER_S // 10
"""A sweep whose returns all lie to one side is shorter, but begins no later after its stamp."""
_MAX_WRONG_SHARE = 0.05
"""Share of the points whose times may be damaged; with more of them nothing tells which times are right."""
_LEAST_UNSET_SHARE, _MOST_UNSET_SHARE, _UNSET_RATIO = 0.01, 0.7, 5
"""Shares of points whose time 0 may mean that there is none, and their ratio to those of any other time: a
spinning LiDAR's first column has as many as the others. With more of them the field holds no times."""
_SAMPLED = 1000
_PERIODS = (float(1 << 32), *(s * unit for s in (1, 3600, 86_400, 604_800) for unit in UNITS_PER_S))
"""Counts after which times begin anew: 32 bits; a second, an hour, a day and a week in every unit."""
_NEARLY_ALL = 0.99
"""Share of a period that times span which began anew during a sweep."""

_SAME_STEP_RAD, _NEXT_STEP_RAD = 1e-6, 0.1
"""Azimuths of consecutive points of a spinning LiDAR's file: of one column, or of two columns nearby."""
_FEWEST_STEPS, _MIN_ONE_WAY = 100, 0.5
"""Steps, and the share of them in one direction less that in the other: near none in files of another
order."""


def time_field(names: Iterable[str]) -> str | None:
    """Return the first name, in its own case, that drivers give a point's time, or that is like one."""
    names = list(names)
    known = (name for name in names if name.lower() in TIME_FIELDS)
    return next(known, next(filter(_LIKE_TIME.search, names), None))


def field_times_s(name: str, values: NDArray[np.number], stamp_ns: int) -> NDArray[np.float32] | None:
    """Return the times in a field as :func:`relative_times_s`; None too of names like it without an order."""
    if name.lower() not in TIME_FIELDS and (values[1:] < values[:-1]).sum() > _MOST_BACK * len(values):
        return None
    return relative_times_s(values, stamp_ns)


def relative_times_s(values: NDArray[np.number], stamp_ns: int) -> NDArray[np.float32] | None:
    """Return the times of a sweep's points, seconds after its stamp.

    The unit is the coarsest of s, ms, µs and ns in which the sweep lasts at most ``MAX_SWEEP_S``: each is
    a thousand of the next, so it is the right one of every sweep longer than 2 ms. Values from
    ``MAX_SWEEP_S`` before zero to the sweep's own duration after it are offsets from the stamp already;
    others within ``MAX_SWEEP_S`` of the stamp are times on its clock; all others are on a clock of the
    sensor's own, such as the last 32 bits of the epoch's nanoseconds, and the first point is taken at the
    stamp.

    A few values that are not within ``MAX_SWEEP_S`` of the others are damaged: the driver wrote zero or NaN.
    So are zeros among offsets that are far more than the points of any other time. Where a counter of 32
    bits, or of the second, hour, day or week began anew, it is counted on.

    Args:
        values: (N,) of any integer or floating type, of the points that measured something.
        stamp_ns: Time of the scan, nanoseconds.

    Returns:
        (N,) float32 seconds, negative before the stamp, NaN where damaged; None where the values are no
        times: none, all or most of them the same, not finite, or further apart than a sweep lasts.
    """
    if len(values) == 0:
        return None
    values = counted_on(np.ascontiguousarray(values))  # contiguous ones are read faster, and three times
    middle, units_per_s = _middle_and_unit(values)
    if units_per_s is None:
        return None
    first, last = values.min(), values.max()  # NaN is the least and the largest of all
    if not (np.isfinite(first) and np.isfinite(last) and _less(last, first) <= MAX_SWEEP_S * units_per_s):
        return _without_damage(values, middle, units_per_s, stamp_ns)
    if first == last:
        return None
    times_s = _after_stamp_s(values, first, units_per_s, stamp_ns)
    is_zero = values == 0
    if is_zero.mean() > _LEAST_UNSET_SHARE:
        _, counts = np.unique(values[~is_zero], return_counts=True)
        if is_zero.sum() > _UNSET_RATIO * counts.max():
            if is_zero.mean() > _MOST_UNSET_SHARE:
                return None
            times_s[is_zero] = np.nan
    return times_s


def times_told(
    names: Sequence[str], values_of: Callable[[str], NDArray[np.number]], stamp_ns: int
) -> tuple[list[str], list[str]]:
    """Return unit and reference of the times of points, and what may be wrong with them, in sentences.

    Args:
        names: Fields of the first cloud.
        values_of: Returns the values of one, of the points that measured something.
        stamp_ns: Time of that cloud, nanoseconds.
    """
    name = time_field(names)
    if name is None:
        return [], []
    recorded = values_of(name)
    if not len(recorded):
        return [], []
    if field_times_s(name, recorded, stamp_ns) is None:
        is_coarse = recorded.dtype == np.float32 and np.abs(recorded).max() > _MOST_IN_FLOAT32
        why = ": its 32 bits are too few for seconds since 1970" if is_coarse else ""
        return [], [f"field {name} of the first cloud holds no times{why}; not deskewed"]
    values = counted_on(recorded)
    middle, units_per_s = _middle_and_unit(values)
    assert units_per_s is not None
    sound = values[np.abs(_signed_less(values, middle)) <= MAX_SWEEP_S * units_per_s]
    sweep_ns = round(float(_less(sound.max(), sound.min())) * (NS_PER_S // units_per_s))
    reference = _reference(_ns(sound.min(), units_per_s), sweep_ns, stamp_ns)
    notes = [] if values is recorded else [f"field {name} begins anew during a sweep; counted on"]
    if reference is _Reference.OWN_CLOCK:
        notes.append(
            f"field {name} is on a clock of its own; the first point of each sweep is taken to be measured "
            "at its stamp"
        )
    return [f"times of points: field {name}, {_UNIT_NAMES[units_per_s]} {reference.value}"], notes


def without_untimed(scan: Scan) -> Scan:
    """Return a scan without the returns whose time is NaN, which are counted."""
    if scan.times_s is None or not np.isnan(scan.times_s.sum()):
        return scan
    timed = ~np.isnan(scan.times_s)
    return replace(scan.select(timed), untimed_returns=int((~timed).sum()))


def counted_on(values: NDArray[np.number]) -> NDArray[np.number]:
    """Return the values as if a counter had not begun anew during the sweep; the same array if it has not."""
    first, last = values.min(), values.max()
    if not (np.isfinite(first) and np.isfinite(last)):
        return values
    span = float(_less(last, first))
    period = next((p for p in _PERIODS if _NEARLY_ALL * p < span <= p), None)
    if period is None:
        return values
    ordered = np.sort(values)
    steps = _less(ordered[1:], ordered[0]) - _less(ordered[:-1], ordered[0])
    widest = int(steps.argmax())
    if steps[widest] < 0.5 * period:
        return values
    wide = values.astype(np.float64 if values.dtype.kind == "f" else np.int64)
    wide[values <= ordered[widest]] += int(period)
    return wide


def _middle_and_unit(values: NDArray[np.number]) -> tuple[np.number, int | None]:
    """Return a time in the middle of the sweep and how many units a second has, by most of the values."""
    # At random, as damage may repeat with every ring or column of the sensor.
    sampled = np.random.default_rng(0).integers(len(values), size=_SAMPLED)
    ordered = np.sort(values if len(values) <= _SAMPLED else values[sampled])
    damaged = int(_MAX_WRONG_SHARE * len(ordered))
    middle = ordered[len(ordered) // 2]
    most = ordered[damaged : len(ordered) - damaged]
    if not (np.isfinite(most[0]) and np.isfinite(most[-1])):
        return middle, None
    span = float(_less(most[-1], most[0]))
    return middle, next((unit for unit in UNITS_PER_S if span <= MAX_SWEEP_S * unit), None)


def _without_damage(
    values: NDArray[np.number], middle: np.number, units_per_s: int, stamp_ns: int
) -> NDArray[np.float32] | None:
    """Return the same times with NaN for those far from the middle; None where they are too many."""
    with np.errstate(invalid="ignore"):  # of damaged numbers, which may be signalling NaN
        after_middle = _signed_less(values, middle)
        sound = np.abs(after_middle) <= MAX_SWEEP_S * units_per_s
    if (~sound).mean() > _MAX_WRONG_SHARE:
        return None
    first, last = float(after_middle[sound].min()), float(after_middle[sound].max())
    if first == last:
        return None
    first_ns = _ns(middle, units_per_s) + round(first * (NS_PER_S // units_per_s))
    after_first_s = np.where(sound, after_middle - first, np.nan) / units_per_s
    sweep_ns = round((last - first) * (NS_PER_S // units_per_s))
    first_after_stamp_ns = _first_after_stamp_ns(first_ns, sweep_ns, stamp_ns)
    return (after_first_s + first_after_stamp_ns / NS_PER_S).astype(np.float32)


def _after_stamp_s(
    values: NDArray[np.number], first: np.number, units_per_s: int, stamp_ns: int
) -> NDArray[np.float32]:
    """Return times after the stamp of values of a known unit, the least of which is ``first``."""
    after_stamp_s = _less(values, first)
    after_stamp_s /= units_per_s
    sweep_ns = round(float(after_stamp_s.max()) * NS_PER_S)
    after_stamp_s += _first_after_stamp_ns(_ns(first, units_per_s), sweep_ns, stamp_ns) / NS_PER_S
    return after_stamp_s.astype(np.float32)


def _ns(value: np.number, units_per_s: int) -> int:
    number: float = value.item()  # type: ignore[assignment]
    return round(number * (NS_PER_S // units_per_s))


class _Reference(Enum):
    """What times count from."""

    STAMP = "from the stamp"
    SAME_CLOCK = "on the clock of the stamps"
    OWN_CLOCK = "on a clock of their own"


def _reference(first_ns: int, sweep_ns: int, stamp_ns: int) -> _Reference:
    limit_ns = MAX_SWEEP_S * NS_PER_S
    if -limit_ns <= first_ns <= max(sweep_ns, _USUAL_SWEEP_NS):
        return _Reference.STAMP
    return _Reference.SAME_CLOCK if abs(first_ns - stamp_ns) <= limit_ns else _Reference.OWN_CLOCK


def _first_after_stamp_ns(first_ns: int, sweep_ns: int, stamp_ns: int) -> int:
    """Return how long after the stamp the first point was measured, by the clock that its time is on."""
    match _reference(first_ns, sweep_ns, stamp_ns):
        case _Reference.STAMP:
            return first_ns
        case _Reference.SAME_CLOCK:
            return first_ns - stamp_ns
        case _Reference.OWN_CLOCK:
            return 0


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


def _signed_less(values: NDArray[np.number], middle: np.number) -> Array:
    """As ``_less``, where values may be smaller than what is subtracted."""
    if values.dtype != np.uint64:
        return _less(values, middle)
    after: Array = np.subtract(values, middle).view(np.int64).astype(np.float64)
    return after
