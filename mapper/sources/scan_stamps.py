"""Stamps of the files in a folder: by their names, by a list beside them, or by their numbers and a rate."""

import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, SourceError
from mapper.core.timebase import NS_PER_S, Stamps, ns_from_date_text, ns_from_seconds_text
from mapper.sources.text import MOST_NS, MOST_STAMP_DIGITS, epoch_ns, parse_date, parse_stamp, rows

RATE_HZ = 10.0

_DECIMAL = re.compile(r"(?<!\d)\d{1,10}\.\d+$")
_DECIMAL_MS = re.compile(r"(?<!\d)\d{13}\.\d+$")  # since 1970, as librealsense's rs-convert writes them
_DECIMAL_FIRST = re.compile(r"(?<!\d)\d{10}\.\d+(?=[_-]\d+$)")  # and a counter
_DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_]?(\d\d)[-_]?(\d\d)[-_T]?(\d\d)[-_h]?(\d\d)[-_m]?(\d\d)(?:[-_.](\d{1,9}))?Z?$"
)
_TWO_PARTS = re.compile(r"(?<!\d)(\d{10})[_-](\d{1,9})$")
_WHOLE = re.compile(r"(?<!\d)\d+$")
_NUMBER = re.compile(r"\d+(?=\D*$)")
_UNIT_DIGITS = (3, 6, 9)  # of ms, µs and ns in a second
_LIST = re.compile(
    r"(?:(?:rgb|colou?r|images?|frames?|camera|lidar|velodyne|scans?)_?)?(?:times?|(?:time_?)?stamps?)\.(?:txt|csv)",
    re.IGNORECASE,
)
_ENDING = re.compile(r"\.[A-Za-z]\w*$")
_LEAST_STEP_US, _LEAST_STEP_MS = 2000, 10
"""Whole numbers that advance by less are no microseconds, as 500 images a second are the most that cameras
take, and no milliseconds."""

BY_NUMBERS = "by the numbers in their names, from 0 on"
UNPADDED_NOTE = "fractions of the stamps are taken as whole numbers without leading zeros"


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Return clouds by the stamps in their names, or else by the names, whose numbers count as numbers."""
    by_name = sorted(paths, key=lambda path: (_natural(path.name), path.name))
    stamps_ns = _stamps_of(by_name)
    if stamps_ns is None:
        return by_name
    return [by_name[i] for i in np.argsort(stamps_ns, kind="stable")]


@dataclass(frozen=True, slots=True)
class Wording:
    """Words of messages about stamps: what the files are, and the settings for their rate and list."""

    files: str = "scans"
    rate: str = "source.rate_hz"
    stamps_file: str = "source.stamps_file"


def scan_stamps(
    files: Sequence[Path],
    *,
    chosen: Path | None,
    beside: Path | None,
    rate_hz: float | None,
    wording: Wording = Wording(),
    recorded: Callable[[], Stamps | None] = lambda: None,
) -> tuple[Stamps, list[str]]:
    """Return when each cloud was taken, nanoseconds, and a note where that is assumed.

    Args:
        files: The clouds, in the order of a list's lines.
        chosen: List of stamps that the user named; it goes before the stamps in names.
        beside: List of stamps found by its own name; it comes after them.
        rate_hz: Scans a second without any stamps; None is 10.
        wording: Words of the message, for files that are no clouds.
        recorded: Returns the stamps that the files' own contents have, used where nothing else states any.

    Raises:
        SourceError: The list is malformed, or has not one stamp for every cloud.
    """
    named = None if chosen else _stamps_of(files)
    if named is not None:
        is_unpadded = unpadded_stamps([path.stem for path in files]) is not None
        return named, [UNPADDED_NOTE] if is_unpadded else []
    if listed := chosen or beside:
        return listed_stamps(listed, files, wording)
    if rate_hz is None and (stamps_ns := recorded()) is not None:
        return stamps_ns, []
    rate_hz = rate_hz or RATE_HZ
    numbers = numbers_of(files)
    step = 1 if numbers is None else int(np.gcd.reduce(numbers - numbers.min()))
    counts = range(len(files)) if numbers is None else numbers.tolist()
    note = (
        f"no stamps in the names or in a times.txt; {rate_hz:g} {wording.files} a second assumed "
        f"({wording.rate}){f'; the numbers go in steps of {step}' if step > 1 else ''}"
    )
    return np.array([stamp_at(count, rate_hz=rate_hz) for count in counts], dtype=np.int64), [note]


def numbers_of(files: Sequence[Path]) -> NDArray[np.int64] | None:
    """Return the last whole number in each name; None where one has none or two have the same."""
    found = [_NUMBER.search(path.stem) for path in files]
    numbers = [int(number[0]) for number in found if number]
    if len(set(numbers)) < len(files) or max(numbers) >= 2**31:
        return None
    return np.array(numbers, dtype=np.int64)


def line_of_each(files: Sequence[Path], total: int) -> NDArray[np.int64] | None:
    """Return which of ``total`` lines, from 0, belongs to each cloud: as many lines, else the names' numbers.

    A number may lie beyond the last line. None where neither pairs them.
    """
    return np.arange(total) if total == len(files) else numbers_of(files)


def stamps_list(folders: Iterable[Path]) -> Path | None:
    """Return the first list of stamps in some folders, by its name."""
    for folder in folders:
        found = [path for path in folder.glob("*.*") if _LIST.fullmatch(path.name) and path.is_file()]
        if found:
            return min(found, key=lambda path: (len(path.name), path.name))
    return None


def listed_stamps(
    path: Path, files: Sequence[Path], wording: Wording = Wording()
) -> tuple[Stamps, list[str]]:
    """Return the stamp of each file by a list's lines, and a note where their unit is a guess.

    A line has a stamp; or the name or the number of a file, and its stamp, in either order.

    Raises:
        SourceError: A line has neither, or the lines are not those of the files.
    """
    lines = _stamp_lines(path)
    numbers = numbers_of(files)
    keys = [{_key_of(file.name)} for file in files]
    if numbers is not None:
        keys = [{*own, f"{number}"} for own, number in zip(keys, numbers.tolist(), strict=True)]
    known = set[str]().union(*keys)
    named = [sum(_key_of(words[k]) in known for _, words in lines if len(words) == 2) for k in (0, 1)]
    at = 0 if named[1] > named[0] else -1
    stamps_ns, notes = _in_one_unit([(where, words[at]) for where, words in lines], path.name)
    if any(named):
        of_key = {_key_of(words[-1 - at]): ns for (_, words), ns in zip(lines, stamps_ns, strict=True)}
        found = [next((of_key[key] for key in sorted(own) if key in of_key), None) for own in keys]
        if None in found:
            raise SourceError(f"{path}: no line has the stamp of {files[found.index(None)].name}")
        return np.array(found, dtype=np.int64), notes
    of_files = line_of_each(files, len(stamps_ns))
    if of_files is None or of_files.max() >= len(stamps_ns):
        raise SourceError(
            f"{path}: {len(stamps_ns)} stamps for {len(files)} {wording.files}; want a line for each, "
            f"or for each number in their names from 0 on ({wording.stamps_file} names another list)"
        )
    if of_files.max() < len(stamps_ns) - 1:  # drives lack scans within, but not at their end
        notes.append(f"{path.name}: {len(stamps_ns)} stamps for {len(files)} {wording.files}, {BY_NUMBERS}")
    return np.array(stamps_ns, dtype=np.int64)[of_files], notes


def _stamp_lines(path: Path) -> list[tuple[str, list[str]]]:
    """Return place and words of a list's lines, all one or all two; a date and its time of day are one."""
    lines: list[tuple[str, list[str]]] = []
    for number, separated in rows(path):
        words = " ".join(separated).replace(",", " ").split()
        if not lines and not any(word[0].isdigit() for word in words):
            continue  # a header
        if len(words) == 2 and "-" in words[0][1:] and ":" in words[1]:  # KITTI's raw recordings
            words = [" ".join(words)]
        lines.append((f"{path}:{number}", words))
        if len(words) != len(lines[0][1]) or len(words) > 2:
            raise SourceError(
                f"{path}:{number}: {len(words)} columns, want 1: a stamp, or 2: a file's name or number, "
                "and its stamp"
            )
    return lines


def _key_of(word: str) -> str:
    """Return a file's number, or its name without folder and ending; of a stamp the stamp."""
    name = _ENDING.sub("", Path(word).name)
    return f"{int(name)}" if name.isdecimal() else name


def _in_one_unit(stamps: Sequence[tuple[str, str]], name: str) -> tuple[list[int], list[str]]:
    """Return nanoseconds of places and texts of stamps, and a note on a unit that their steps tell."""
    counts = [int(text) for _, text in stamps if text.isdecimal() and len(text) < MOST_STAMP_DIGITS]
    are_counts = len(counts) == len(stamps) and any(epoch_ns(text) is None for _, text in stamps)
    unit = unit_of_counts(counts, least_ms=_LEAST_STEP_MS) if are_counts else None
    if unit is not None and max(counts) * unit.ns < MOST_NS:
        note = f"{name}: whole numbers are taken for {unit.name}: they advance by {unit.step}"
        return [count * unit.ns for count in counts], [note]
    return [
        parse_date(text, where=where) if " " in text else parse_stamp(text, where=where)
        for where, text in stamps
    ], []


@dataclass(frozen=True, slots=True)
class CountUnit:
    """Unit of whole numbers that are times, and the usual step in it."""

    name: str
    ns: int
    step: int


def unit_of_counts(numbers: Sequence[int], *, least_ms: float = inf) -> CountUnit | None:
    """Return the unit of increasing numbers that advance as times do; None where they count.

    Args:
        numbers: In order.
        least_ms: Step from which they are milliseconds.
    """
    step = int(np.median(np.diff(numbers))) if len(numbers) > 1 else 0
    units = (
        (_LEAST_STEP_US * 1000, "nanoseconds", 1),
        (_LEAST_STEP_US, "microseconds", 1_000),
        (least_ms, "milliseconds", 1_000_000),
    )
    return next((CountUnit(name, ns, step) for least, name, ns in units if step >= least), None)


def stamp_at(number: int, *, rate_hz: float) -> int:
    """Return when the image of this number was taken, nanoseconds; number 0 at time 0."""
    return round(number * NS_PER_S / rate_hz)


def _stamps_of(files: Sequence[Path]) -> Stamps | None:
    return stamps_in([path.stem.removesuffix(".pcd") for path in files])  # nuScenes' STAMP.pcd.bin


def stamps_in(stems: Sequence[str]) -> Stamps | None:
    """Return the stamps that names without their endings end with, nanoseconds; None if one has none.

    pcl_ros once wrote SECONDS.NANOSECONDS without leading zeros; such fractions are whole numbers of a unit.
    """
    unpadded_ns = unpadded_stamps(stems)
    if unpadded_ns is not None:
        return unpadded_ns
    stamps_ns = [_stamp_in(stem) for stem in stems]
    if any(stamp_ns is None for stamp_ns in stamps_ns):
        return None
    return np.array(stamps_ns, dtype=np.int64)


def unpadded_stamps(stems: Sequence[str]) -> Stamps | None:
    """Return stamps with fractions of whole ms, µs or ns without leading zeros; None where they are decimals.

    Such fractions differ in length and none begins with a zero. So may decimals that lost the zeros at their
    ends, but as those the stamps are at least twice as uneven.
    """
    parts = [found[0].split(".") for stem in stems if (found := _DECIMAL.search(stem))]
    fractions = [fraction for _, fraction in parts]
    lengths = {len(fraction) for fraction in fractions}
    starts_with_zero = any(fraction != "0" and fraction.startswith("0") for fraction in fractions)
    if len(parts) < len(stems) or len(lengths) < 2 or starts_with_zero:
        return None
    decimal_ns = np.array([ns_from_seconds_text(".".join(part)) for part in parts], dtype=np.int64)
    if (digits := max(lengths)) not in _UNIT_DIGITS:
        return None
    padded = [f"{seconds}.{fraction:0>{digits}}" for seconds, fraction in parts]
    whole_ns = np.array([ns_from_seconds_text(text) for text in padded], dtype=np.int64)
    return whole_ns if 2.0 * _unevenness_ns(whole_ns) < _unevenness_ns(decimal_ns) else None


def _unevenness_ns(stamps_ns: Stamps) -> float:
    return float(np.diff(np.sort(stamps_ns)).std())


def _stamp_in(stem: str) -> int | None:
    if found := _DATE.search(stem):
        year, month, day, hour, minute, second, fraction = found.groups(default="0")
        with suppress(DataError):
            return ns_from_date_text(f"{year}-{month}-{day} {hour}:{minute}:{second}.{fraction}")
    if found := _DECIMAL_MS.search(stem):
        return epoch_ns(found[0])
    if found := _DECIMAL.search(stem) or _DECIMAL_FIRST.search(stem):
        return ns_from_seconds_text(found[0])
    if found := _TWO_PARTS.search(stem):
        return int(found[1]) * NS_PER_S + int(found[2])
    found = _WHOLE.search(stem)
    return epoch_ns(found[0]) if found else None


def _natural(name: str) -> list[str | int]:
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]
