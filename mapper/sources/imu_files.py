"""Inertial readings beside a log: ``imu.csv`` as of EuRoC, or angular velocities in ``gyroscope.txt``."""

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import Array
from mapper.core.timebase import Stamps, seconds_text_from_ns
from mapper.core.units import unit_of_gravity
from mapper.sensing.gyroscope import Gyroscope, range_end
from mapper.sources.base import Accelerations
from mapper.sources.text import parse_numbers, parse_stamp, read_lines, rows, table, time_order

BOTH, RATES = "imu.csv", "gyroscope.txt"
_COLUMNS = np.dtype([("stamp_ns", "<i8"), ("rates", "<f8", 3), ("accelerations", "<f8", 3)])
_NAMES = (BOTH, "imu.txt", "IMU.csv", "imu_data.csv", "imu_data.txt")
_BETWEEN = r"\s*[,;]\s*|\s+"
_RATES, _ACCELERATIONS = "(?:w|g(?!rav)|ang(?!le)|omega|rot(?!ation_?[xyz]$))", "(?:a(?!ng|lpha)|lin)"
"""Beginnings of the names of columns."""
_STRAY_COLUMNS = ("timestamp", "a_x", "a_y", "a_z", "alpha_x", "alpha_y", "alpha_z")
_SHAKEN = 1.2
"""The end of a range is beyond this many times gravity: of those at rest many are the largest."""
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
            Stray Scanner's, of which the angular velocities are read, or one that names the columns) or
            ``gyroscope.txt`` (``stamp wx wy wz``); rad/s and m/s², in the unit's own axes.

    Raises:
        SourceError: A file is malformed.
    """
    if (folder / RATES).is_file():
        path = folder / RATES
        stamps_ns, rates = [], []
        for where, words in table(path, "stamp", "wx", "wy", "wz"):
            stamps_ns.append(parse_stamp(words[0], where=where))
            rates.append(parse_numbers(words[1:], where=where))
        stamps = np.array(stamps_ns, np.int64)
        gyroscope, notes = gyroscope_of(path.name, stamps, np.array(rates, np.float64).reshape(-1, 3))
        return gyroscope, None, notes
    named = [one for name in _NAMES if (one := folder / name).is_file()]
    if not named:
        return None, None, []
    path = named[0]
    lines = read_lines(path)
    if lines and all(name in lines[0] for name in _STRAY_COLUMNS):
        return _stray_rates(path, lines)
    if lines and "w_RS_S_x" in lines[0]:
        return _readings(path, lines)
    return _by_columns(path)


def read_euroc_imu(path: Path) -> tuple[Gyroscope | None, Accelerations | None, list[str]]:
    """Return the readings of EuRoC's lines ``stamp_ns,wx,wy,wz,ax,ay,az`` (Burri et al. 2016), and notes.

    Raises:
        SourceError: The file is malformed.
    """
    return _readings(path, read_lines(path))


def _readings(path: Path, lines: Sequence[str]) -> tuple[Gyroscope | None, Accelerations | None, list[str]]:
    try:
        readings = np.loadtxt(lines, _COLUMNS, delimiter=",", ndmin=1)
    except ValueError as error:
        lengths = ((number, len(words)) for number, words in rows(path, separator=","))
        wrong = (f"line {number} has {n} columns between commas" for number, n in lengths if n != 7)
        raise SourceError(f"{path}: {next(wrong, error)}; want stamp_ns,wx,wy,wz,ax,ay,az") from None
    gyroscope, notes = gyroscope_of(path.name, readings["stamp_ns"], readings["rates"])
    accelerations, more = accelerations_of(path.name, readings["stamp_ns"], readings["accelerations"])
    return gyroscope, accelerations, list(dict.fromkeys([*notes, *more]))


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
    if second.size and _feels_gravity(second):
        second = second * (unit_of_gravity(_usual_length(second)) or 1.0)
    gyroscope, notes = gyroscope_of(path.name, stamps_ns, first)
    accelerations, more = accelerations_of(path.name, stamps_ns, second) if second.size else (None, [])
    return gyroscope, accelerations, list(dict.fromkeys([*notes, *more]))


def _columns_of(header: str, width: int) -> list[int]:
    """Return the columns of the stamp, of the angular velocities, and of the accelerations where named."""
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
    return [stamps[0], *of["rates"], *(of["accelerations"] if len(of["accelerations"]) == 3 else [])]


def _is_number(word: str) -> bool:
    with suppress(ValueError):
        return bool(float(word) or True)
    return False


def _feels_gravity(readings: Array) -> bool:
    return unit_of_gravity(_usual_length(readings)) is not None


def _usual_length(readings: Array) -> float:
    return float(np.median(np.linalg.norm(np.clip(readings, -_MOST_READING, _MOST_READING), axis=1)))


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


def _stray_rates(path: Path, lines: Sequence[str]) -> tuple[Gyroscope | None, None, list[str]]:
    """Return the angular velocities of Stray Scanner's imu.csv, whose stamps are seconds.

    Its accelerations point down at rest in some versions, and in others lack gravity.
    """
    at = [[word.strip() for word in lines[0].split(",")].index(name) for name in _STRAY_COLUMNS]
    stamps_ns, rates = [], []
    for number, line in enumerate(lines[1:], start=2):
        words, where = line.split(","), f"{path}:{number}"
        if len(words) <= max(at):
            raise SourceError(f"{where}: {len(words)} columns, want {', '.join(_STRAY_COLUMNS)}")
        stamps_ns.append(parse_stamp(words[at[0]].strip(), where=where))
        rates.append(parse_numbers([words[i] for i in at[4:]], where=where))
    stamps = np.array(stamps_ns, np.int64)
    gyroscope, notes = gyroscope_of(path.name, stamps, np.array(rates, np.float64).reshape(-1, 3))
    return gyroscope, None, notes


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
    name: str, stamps_ns: Stamps, acceleration_mps2: Array
) -> tuple[Accelerations | None, list[str]]:
    """Return the finite readings in time order, None without any, and notes; arguments as above."""
    stamps_ns, acceleration_mps2, notes = _finite(name, stamps_ns, acceleration_mps2, what="accelerations")
    if not len(stamps_ns):
        return None, [*notes, f"{name}: no accelerations"]
    return Accelerations(stamps_ns, acceleration_mps2), [*notes, *saturation_notes(name, acceleration_mps2)]


def saturation_notes(name: str, accelerations: Array) -> list[str]:
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
