"""Inertial readings beside a log: ``imu.csv`` as of EuRoC, or angular velocities in ``gyroscope.txt``."""

import re
from contextlib import suppress
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import Array
from mapper.core.timebase import Stamps, seconds_text_from_ns
from mapper.core.units import GRAVITY_MPS2, unit_of_gravity
from mapper.sensing.gyroscope import Gyroscope, range_end
from mapper.sources.base import Accelerations
from mapper.sources.text import parse_numbers, parse_stamp, read_lines, rows, stamped_numbers, time_order

BOTH, RATES = "imu.csv", "gyroscope.txt"
_COLUMNS = np.dtype([("stamp_ns", "<i8"), ("rates", "<f8", 3), ("accelerations", "<f8", 3)])
_NAMES = (BOTH, "imu.txt", "IMU.csv", "imu_data.csv", "imu_data.txt")
_BETWEEN = r"\s*[,;]\s*|\s+"
_RATES, _ACCELERATIONS = "(?:w|g(?!rav)|alpha|ang(?!le)|omega|rot(?!ation_?[xyz]$))", "(?:a(?!ng|lpha)|lin)"
"""Beginnings of the names of columns."""
_SHAKEN = 1.2
"""The end of a range is beyond this many times gravity: of those at rest many are the largest."""
_LEAST_WITH_GRAVITY, _LEAST_MEAN = 0.55, 0.5
"""Tenth percentile of the lengths of accelerations, and length of their mean, in the median length, of which
those that feel gravity exceed one: 0.55 if shaken by 0.4 g in each axis; of noise without it 0.5, of driving
0.3, and their mean is near 0, as that of gravity is only in a unit that tumbles."""
BOTH_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
"""First line of the file (Burri et al. 2016)."""
_MOST_READING = 1e9
"""Readings in the smallest unit in use, mdeg/s, are below it."""


def read_imu(folder: Path) -> tuple[Gyroscope | None, Accelerations | None, list[str]]:
    """Return angular velocities and accelerations of a log's folder, as far as it has them, and notes.

    Args:
        folder: Folder that may hold ``imu.csv`` (``stamp_ns,wx,wy,wz,ax,ay,az``, its first line EuRoC's, or
            one that names the columns, as Stray Scanner's, of which the angular velocities are read) or
            ``gyroscope.txt`` (``stamp wx wy wz``); rad/s and m/s², in the unit's own axes.

    Raises:
        SourceError: A file is malformed.
    """
    if (path := folder / RATES).is_file():
        gyroscope, notes = gyroscope_of(path.name, *stamped_numbers(path, "stamp", "wx", "wy", "wz"))
        return gyroscope, None, notes
    named = [one for name in _NAMES if (one := folder / name).is_file()]
    if not named:
        return None, None, []
    is_eurocs = "w_RS_S_x" in "".join(read_lines(named[0])[:1])
    return read_euroc_imu(named[0]) if is_eurocs else _by_columns(named[0])


def read_accelerometer(folder: Path) -> tuple[Accelerations | None, list[str]]:
    """Return the readings of ``accelerometer.txt`` (lines of ``stamp ax ay az``), if the folder has one.

    Raises:
        SourceError: A line is not four numbers.
    """
    path = folder / "accelerometer.txt"
    if not path.is_file():
        return None, []
    return accelerations_of(path.name, *stamped_numbers(path, "stamp", "ax", "ay", "az"))


def read_euroc_imu(path: Path) -> tuple[Gyroscope | None, Accelerations | None, list[str]]:
    """Return the readings of EuRoC's lines ``stamp_ns,wx,wy,wz,ax,ay,az`` (Burri et al. 2016), and notes.

    Raises:
        SourceError: The file is malformed.
    """
    try:
        readings = np.loadtxt(read_lines(path), _COLUMNS, delimiter=",", ndmin=1)
    except ValueError as error:
        lengths = ((number, len(words)) for number, words in rows(path, separator=","))
        wrong = (f"line {number} has {n} columns between commas" for number, n in lengths if n != 7)
        raise SourceError(f"{path}: {next(wrong, error)}; want stamp_ns,wx,wy,wz,ax,ay,az") from None
    return _both(path.name, readings["stamp_ns"], readings["rates"], readings["accelerations"])


def _both(
    name: str, stamps_ns: Stamps, rates_radps: Array, accelerations: Array
) -> tuple[Gyroscope | None, Accelerations | None, list[str]]:
    gyroscope, notes = gyroscope_of(name, stamps_ns, rates_radps)
    felt, more = accelerations_of(name, stamps_ns, accelerations) if accelerations.size else (None, [])
    return gyroscope, felt, list(dict.fromkeys([*notes, *more]))


def _by_columns(path: Path) -> tuple[Gyroscope | None, Accelerations | None, list[str]]:
    """Return the readings of a table whose header names its columns, or of seven: a stamp, and two by three.

    Without a header those that feel gravity are the accelerations. The header tells degrees, the length g.
    """
    lines = [(number, line) for number, line in enumerate(read_lines(path), start=1) if line.strip()]
    header = next((line for _, line in lines[:1] if not _is_number(re.split(_BETWEEN, line.strip())[0])), "")
    found = [(number, re.split(_BETWEEN, line.strip())) for number, line in lines[1 if header else 0 :]]
    width = len(found[0][1]) if found else 0
    at = _columns_of(header, width) if header else list(range(7)) * (width == 7)
    if not at or any(len(words) != width for _, words in found):
        return (
            None,
            None,
            [f"{path.name}: its columns are not known, want {BOTH_HEADER.lstrip('#')}; not used"],
        )
    stamps_ns = np.array([parse_stamp(words[at[0]], where=f"{path}:{n}") for n, words in found], np.int64)
    numbers = [parse_numbers([words[k] for k in at[1:]], where=f"{path}:{n}") for n, words in found]
    first, second = np.array(numbers)[:, :3], np.array(numbers)[:, 3:]
    if not header and _feels_gravity(first) and not _feels_gravity(second):
        first, second = second, first
    if re.search("deg|°", header):
        first = np.radians(first)
    return _both(path.name, stamps_ns, first, second)


def _columns_of(header: str, width: int) -> list[int]:
    """Return the columns of the stamp, of the angular velocities, and of the accelerations where named.

    Those of Stray Scanner point down at rest in some versions, and in others lack gravity: they are left out.
    """
    words = re.sub(r"[\[(][^\])]*[\])]", "", header).strip("# \t").lower()
    separator = next((one for one in ",;\t" if one in words), None)
    names = [word.strip().strip('"') for word in words.split(separator)]
    of = {
        kind: [k for axis in "xyz" for k, name in enumerate(names) if re.fullmatch(f"{begin}.*{axis}", name)]
        for kind, begin in (("rates", _RATES), ("accelerations", _ACCELERATIONS))
    }
    stamps = [k for k, name in enumerate(names) if re.match("time|stamp|t$|sec", name)]
    if len(names) != width or not stamps or len(of["rates"]) != 3:
        return []
    is_sound = len(of["accelerations"]) == 3 and "alpha_x" not in names
    return [stamps[0], *of["rates"], *(of["accelerations"] if is_sound else [])]


def _is_number(word: str) -> bool:
    with suppress(ValueError):
        return bool(float(word) or True)
    return False


def _feels_gravity(readings: Array) -> bool:
    return _unit_of(np.clip(readings, -_MOST_READING, _MOST_READING)) is not None


def _unit_of(accelerations: Array) -> float | None:
    """Return the unit of readings that feel gravity, m/s²; None of others."""
    return unit_of_gravity(float(np.median(np.linalg.norm(accelerations, axis=1))))


def write_gyroscope(folder: Path, gyroscope: Gyroscope) -> None:
    """Write the angular velocities as the ``gyroscope.txt`` of a log."""
    lines = ["# angular velocities, rad/s", "# timestamp wx wy wz"]
    for stamp_ns, rates in zip(gyroscope.stamps_ns.tolist(), gyroscope.rates_radps.tolist(), strict=True):
        lines.append(" ".join([seconds_text_from_ns(stamp_ns), *map(repr, rates)]))
    (folder / RATES).write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_imu(folder: Path, gyroscope: Gyroscope, accelerations: Accelerations) -> None:
    """Write both readings as the ``imu.csv`` of a log; their stamps are the same."""
    lines = [BOTH_HEADER]
    for stamp_ns, rates, felt in zip(
        gyroscope.stamps_ns.tolist(),
        gyroscope.rates_radps.tolist(),
        accelerations.acceleration_mps2.tolist(),
        strict=True,
    ):
        lines.append(",".join([str(stamp_ns), *map(repr, rates), *map(repr, felt)]))
    (folder / BOTH).write_text("\n".join(lines) + "\n", encoding="utf-8")


def gyroscope_of(name: str, stamps_ns: Stamps, rates_radps: Array) -> tuple[Gyroscope | None, list[str]]:
    """Return the finite readings in time order within the unit's range, None without any, and notes.

    Args:
        name: Topic or file.
        stamps_ns: (N,) int64 nanoseconds, in any order.
        rates_radps: (N, 3) in the unit's own axes.
    """
    stamps_ns, rates_radps, notes = _finite(name, stamps_ns, rates_radps, what="angular velocities")
    sound, more = Gyroscope(name, stamps_ns, rates_radps).without_faults()
    return sound, [*notes, *more]


def accelerations_of(
    name: str, stamps_ns: Stamps, accelerations: Array
) -> tuple[Accelerations | None, list[str]]:
    """Return the finite readings in time order in m/s², None without any, and notes.

    Args:
        name: Topic or file.
        stamps_ns: (N,) int64 nanoseconds, in any order.
        accelerations: (N, 3) in the unit's own axes; m/s², or g or mg, as their usual length tells.
    """
    stamps_ns, accelerations, notes = _finite(name, stamps_ns, accelerations, what="accelerations")
    if not len(stamps_ns):
        return None, [*notes, f"{name}: no accelerations"]
    lengths = np.linalg.norm(accelerations, axis=1)
    least, usual = np.percentile(lengths[lengths > 0.0], (10.0, 50.0)) if lengths.any() else (0.0, 0.0)
    unit = _unit_of(accelerations)
    mean = np.linalg.norm(accelerations.mean(axis=0))
    if least <= _LEAST_WITH_GRAVITY * usual and mean <= _LEAST_MEAN * usual:
        why = f"a tenth are below {least:.2g} and half below {usual:.2g}"
        return None, [*notes, f"{name}: accelerations lack gravity ({why}); not used: record raw ones"]
    if unit is not None and unit != 1.0:
        accelerations = accelerations * unit
        called = "g" if unit == GRAVITY_MPS2 else "mg"
        notes.append(f"{name}: accelerations are about {GRAVITY_MPS2 / unit:g} at rest: taken as {called}")
    return Accelerations(stamps_ns, accelerations), [*notes, *_saturation_notes(name, accelerations)]


def _saturation_notes(name: str, accelerations: Array) -> list[str]:
    """Return a sentence on the (N, 3) accelerations at the end of the unit's range, if there are any."""
    at_rest = float(np.median(np.linalg.norm(accelerations, axis=1)))
    if (found := range_end(accelerations, beyond=_SHAKEN * at_rest)) is None:
        return []
    limit, saturated = found
    return [
        f"{name}: {saturated.sum()} of {len(accelerations)} accelerations are at the end of the "
        f"accelerometer's range, {limit:g}; record with a wider range, or mount it where it shakes less"
    ]


def _finite(name: str, stamps_ns: Stamps, values: Array, *, what: str) -> tuple[Stamps, Array, list[str]]:
    are_finite = (np.abs(values) < _MOST_READING).all(axis=1)
    order, notes = time_order(stamps_ns[are_finite], what=name)
    if left_out := int((~are_finite).sum()):
        notes.append(
            f"{name}: {left_out} of {len(values)} {what} are not finite or above {_MOST_READING:g}; left out"
        )
    return stamps_ns[are_finite][order], values[are_finite][order], notes
