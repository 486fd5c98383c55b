"""Line-by-line text files of a log, with errors that name the line, and rows put in time order."""

import re
from collections.abc import Iterator, Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, SourceError
from mapper.core.geometry import FARTHEST_M, Array, Transform, is_rigid, nearest_rotation, transform
from mapper.core.rotations import pose_of_row
from mapper.core.timebase import NS_PER_S, UNITS_PER_S, Stamps, ns_from_date_text, ns_from_seconds_text
from mapper.core.trajectory import Positions, Trajectory, without_idle_rotations
from mapper.runtime.regular_files import read_text

ROUNDING = 0.01
"""Error of a rotation in text of few digits; what is farther off is none."""
_MOST_DIGITS = 9  # a year of frames at 30 Hz
_EPOCH_DIGITS = 10  # of seconds, in the years 2001 to 2286
MOST_STAMP_DIGITS, MOST_NS = 20, 2**63
"""Digits of a stamp, and nanoseconds, below which it is held in 64 bits."""


def read_lines(path: Path) -> list[str]:
    """Return a text file's lines.

    Raises:
        SourceError: The file is missing, unreadable, no regular file, too large or not text.
    """
    return read_text(path, error=SourceError).splitlines()


def rows(path: Path, *, separator: str | None = None) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number, words) of every line that is neither blank nor a ``#`` or ``!`` comment.

    Raises:
        SourceError: As :func:`read_lines`.
    """
    for number, line in enumerate(read_lines(path), start=1):
        if line.strip() and not line.lstrip().startswith(("#", "!")):
            yield number, [word.strip() for word in line.split(separator)]


def table(path: Path, *columns: str) -> Iterator[tuple[str, list[str]]]:
    """Yield place and words of every row of a file that has these columns; the place is for messages.

    Columns may be separated by commas, and a first row of letters alone is a header. The name of a file after
    one other column may have blanks, or quotes around it.

    Raises:
        SourceError: As :func:`read_lines`, or a row has another number of columns.
    """
    for k, (number, words) in enumerate(rows(path)):
        where = f"{path}:{number}"
        if k == 0 and re.fullmatch("[A-Za-z_,]+", "".join(words)):
            continue
        if len(words) != len(columns) or any(word.endswith(",") for word in words):
            words = " ".join(words).replace(",", " ").split()
        if columns[1:] == ("filename",) and len(words) > 1:
            words = [words[0], " ".join(words[1:]).strip("\"'")]  # a name with blanks, or quoted
        if len(words) != len(columns):
            raise SourceError(f"{where}: {len(words)} columns, want {len(columns)}: {' '.join(columns)}")
        yield where, words


def stamped_numbers(path: Path, *columns: str) -> tuple[Stamps, Array]:
    """Return the stamps of a file that has these columns, the first a stamp, and its (N, K) other numbers.

    Raises:
        SourceError: As :func:`table`, or a word is no number.
    """
    stamps_ns, numbers = [], []
    for where, words in table(path, *columns):
        stamps_ns.append(parse_stamp(words[0], where=where))
        numbers.append(parse_numbers(words[1:], where=where))
    return np.array(stamps_ns, np.int64), np.array(numbers, np.float64).reshape(-1, len(columns) - 1)


def epoch_ns(text: str) -> int | None:
    """Return s, ms, µs or ns since 1970, told apart by the digits before the point, as nanoseconds."""
    whole, _, fraction = text.partition(".")
    is_number = whole.isdecimal() and len(whole) < MOST_STAMP_DIGITS and f"{fraction}0".isdecimal()
    units = (unit for unit in UNITS_PER_S if is_number and len(f"{int(whole) // unit}") == _EPOCH_DIGITS)
    ns = next((int(Decimal(text) * (NS_PER_S // unit)) for unit in units), MOST_NS)
    return ns if ns < MOST_NS else None


def parse_stamp(text: str, *, where: str) -> int:
    """Return decimal seconds, or ms, µs or ns since 1970, as nanoseconds.

    Raises:
        SourceError: The text is no finite number; the message starts with ``where``.
    """
    try:
        since_epoch_ns = epoch_ns(text)
        return ns_from_seconds_text(text) if since_epoch_ns is None else since_epoch_ns
    except DataError as error:
        raise SourceError(f"{where}: {error}") from None


def parse_date(text: str, *, where: str) -> int:
    """Return a date and time of day, UTC, as nanoseconds since 1970.

    Raises:
        SourceError: The text is no such date; the message starts with ``where``.
    """
    try:
        return ns_from_date_text(text)
    except DataError as error:
        raise SourceError(f"{where}: {error}") from None


def parse_count(text: str, *, where: str) -> int:
    """Return the whole number of an image or a pose.

    Raises:
        SourceError: The text is none; the message starts with ``where``.
    """
    if not text.isdecimal() or len(text) > _MOST_DIGITS:
        raise SourceError(f"{where}: {text!r} is no number of a frame")
    return int(text)


def parse_numbers(words: Sequence[str], *, where: str) -> Array:
    """Return the words as float64; they may be NaN or infinite.

    Raises:
        SourceError: A word is no number; the message starts with ``where``.
    """
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise SourceError(f"{where}: {error}") from None


def time_order(stamps_ns: Stamps, *, what: str) -> tuple[NDArray[np.intp], list[str]]:
    """Return the indices that sort stamps, the first of equal ones only, and a note on what that changed."""
    order = np.argsort(stamps_ns, kind="stable")
    ordered = stamps_ns[order]
    is_first = np.ones(len(order), dtype=bool)
    is_first[1:] = np.diff(ordered) > 0
    notes = []
    if misplaced := int((np.diff(stamps_ns) < 0).sum()):
        notes.append(f"{what}: out of time order in {misplaced} places; sorted")
    if repeated := int((~is_first).sum()):
        notes.append(f"{what}: {repeated} stamps appear twice; the first was kept")
    return order[is_first], notes


def pose_from_numbers(numbers: Array) -> Transform | None:
    """Return the pose of x y z qx qy qz qw; None where motion capture wrote no pose (NaN, or no rotation)."""
    return poses_from_numbers(numbers[None])[0]


def poses_from_numbers(numbers: Array) -> list[Transform | None]:
    """Return the same of each row of (N, 7) numbers."""
    sizes = np.abs(numbers)
    usable = (sizes < FARTHEST_M).all(axis=1) & (sizes[:, 3:].max(axis=1) >= 1e-9)
    kept = numbers[usable]
    poses = iter(pose_of_row(kept))
    return [next(poses) if is_usable else None for is_usable in usable]


def pose_from_matrix(matrix: Sequence[Sequence[float]] | Array) -> Transform | None:
    """Return the pose of three or four rows of four numbers, its rotation made exact; None of no pose.

    Files say that a camera was lost by numbers that are not finite, or by zeros; damaged ones are far off.
    """
    if len({len(row) for row in matrix}) != 1:
        return None
    with np.errstate(invalid="ignore"):  # damaged numbers may be signalling NaN
        T = np.asarray(matrix, np.float64)
    if T.ndim != 2 or T.shape[0] not in (3, 4) or T.shape[1] != 4 or not (np.abs(T) < FARTHEST_M).all():
        return None
    R = nearest_rotation(T[:3, :3])
    return transform(R, T[:3, 3]) if np.abs(R - T[:3, :3]).max() < ROUNDING else None


def told_without_rotations(
    truth: Trajectory | None, notes: list[str], *, what: str
) -> tuple[Trajectory | None, list[str]]:
    """Return a truth as one of positions alone where it has no rotations, with a note on that."""
    if truth is None or not isinstance(truth := without_idle_rotations(truth), Positions):
        return truth, notes
    return truth, [*notes, f"{what}: positions without rotations; taken as the body's own"]


def truth_from(
    poses: Sequence[tuple[int, Transform | None]], *, what: str
) -> tuple[Trajectory | None, list[str]]:
    """Return the truth of (stamp_ns, T_world_body) rows, and notes on rows that had to go.

    Args:
        poses: Stamps and poses in any order; a pose that is None or not a finite rigid motion is dropped.
        what: The file's name, for the notes.
    """
    usable = [(stamp_ns, T) for stamp_ns, T in poses if T is not None and is_rigid(T)]
    notes = []
    if dropped := len(poses) - len(usable):
        notes.append(f"{what}: {dropped} of {len(poses)} poses are not finite rigid motions; dropped")
    if not usable:
        return None, [*notes, f"{what}: no usable pose"]
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in usable], dtype=np.int64)
    order, more = time_order(stamps_ns, what=what)
    T_world_body = np.array([T for _, T in usable])[order]
    return Trajectory(stamps_ns[order], T_world_body), [*notes, *more]
