"""Trajectories as TUM, EuRoC, KITTI and MulRan text, and as tables whose header names the columns."""

import math
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import is_rigid, transform
from mapper.core.rotations import pose_of_row, row_of_pose
from mapper.core.timebase import Stamps, ns_from_seconds_text, seconds_text_from_ns
from mapper.core.trajectory import Positions, Trajectory
from mapper.runtime.atomic import write_text
from mapper.runtime.regular_files import read_text
from mapper.sources.text import ROUNDING, epoch_ns, poses_from_numbers

_EUROC = re.compile(r"\s*\d{16,19}\s*,")
_POSITION = r"(?:.*(?:position|translation)[./_]|p(?:os)?_|p_\w+_|[pt]_?)?{}(?:_m)?"
_QUATERNION = r"(?:.*(?:orientation|rotation|quaternion|quat)[./_]|q_\w+_|q_?){}"
_COLUMNS = {
    "stamp": r"[_#%]*(?:.*stamp.*|u?time.*|gpstime|t|sec(?:s|onds)?)",
    "nanoseconds": r"n(?:ano)?sec(?:s|onds)?",
    **{axis: _POSITION.format(axis) for axis in "xyz"},
    **{f"q{axis}": _QUATERNION.format(axis) for axis in "xyzw"},
}
"""Names of the columns of a pose, in lower case and without units, by EuRoC's, ROS's and other tables."""
_STAMP_UNIT = re.compile(r"(?:stamp|time)\s*[\[(_]([mun])s\b")
_DIGITS = {"m": 3, "u": 6, "n": 9}
_OF_MAPS = {"x": "east(?:ing)?", "y": "north(?:ing)?", "z": "alt(?:itude)?|up|height"}
_MULRAN_COLUMNS = 13
POSE_COLUMNS = ("stamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
POSITION_COLUMNS = POSE_COLUMNS[:4]
_NCLT_COLUMNS = 7
_LAST_ROW = [0.0, 0.0, 0.0, 1.0]
_NUMBER = re.compile(r"[-+.]?\d|nan|inf", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[-+]?\d+(?:,\d+)?(?:e[-+]?\d+)?", re.IGNORECASE)


def read_tum(path: Path) -> Trajectory:
    """Read ``stamp tx ty tz qx qy qz qw`` lines (Sturm et al. 2012), or EuRoC's (Burri et al. 2016).

    EuRoC's have whole nanoseconds, commas, w before x, and velocities and biases after the pose, which are
    left out. A header above the first pose may name the columns in any order, among others. Lines without a
    quaternion, ``stamp x y z``, give positions alone; angles, whose order no two programs share, are left
    out. Stamps may be ms, µs or ns since 1970, and semicolons separate columns. Quaternions are normalised.

    Of two poses with the same stamp the first counts: fr2_desk's truth rounds two samples to one stamp.

    Raises:
        DataError: A line that is not eight or four finite numbers, a zero quaternion, or stamps that
            decrease.
    """
    stamps_ns: list[int] = []
    numbers: list[list[float]] = []
    places: list[str] = []
    kind: type[Trajectory] = Trajectory
    for number, words in tum_rows(path):
        place = f"{path}:{number}"
        kind = Positions if len(words) == len(POSITION_COLUMNS) else kind
        words = whole_row(words, place=place)
        try:
            stamp_ns, pose = epoch_ns(words[0]), [float(word) for word in words[1:]]
            stamp_ns = ns_from_seconds_text(words[0]) if stamp_ns is None else stamp_ns
        except (DataError, ValueError) as error:
            raise DataError(f"{place}: {error}") from None
        if not all(map(math.isfinite, pose)):
            raise DataError(f"{place}: a number is not finite; remove the line")
        if stamps_ns and stamp_ns < stamps_ns[-1]:
            raise DataError(f"{place}: stamp {words[0]} comes before the line above; sort the file")
        if not stamps_ns or stamp_ns > stamps_ns[-1]:
            stamps_ns.append(stamp_ns)
            numbers.append(pose)
            places.append(place)
    if not stamps_ns:
        raise DataError(f"{path}: no poses; want lines of stamp tx ty tz qx qy qz qw")
    poses = []
    for place, pose, T in zip(places, numbers, poses_from_numbers(np.array(numbers)), strict=True):
        if T is None:
            raise DataError(f"{place}: quaternion {tuple(pose[3:])} has no direction; want a non-zero xyzw")
        poses.append(T)
    return kind(np.array(stamps_ns, dtype=np.int64), np.array(poses))


def whole_row(words: list[str], *, place: str) -> list[str]:
    """Return a line's eight words; of positions alone with a rotation of the identity.

    Raises:
        DataError: It has another number of columns.
    """
    if len(words) == len(POSITION_COLUMNS):
        return [*words, "0", "0", "0", "1"]
    if len(words) != len(POSE_COLUMNS):
        raise DataError(f"{place}: {len(words)} columns, want 8: {' '.join(POSE_COLUMNS)}, or the first 4")
    return words


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write TUM text with exact stamps and every digit of the poses, or of the positions."""
    columns = POSITION_COLUMNS if isinstance(trajectory, Positions) else POSE_COLUMNS
    lines = [f"# timestamp {' '.join(columns[1:])}"]
    rows = row_of_pose(trajectory.T_world_body)[:, : len(columns) - 1].tolist()
    for stamp_ns, row in zip(trajectory.stamps_ns.tolist(), rows, strict=True):
        lines.append(" ".join([seconds_text_from_ns(stamp_ns), *map(repr, row)]))
    write_text(path, "\n".join(lines) + "\n")


def read_kitti(path: Path, stamps_ns: Stamps | None = None) -> Trajectory:
    """Read one row-major 3×4 matrix a line (Geiger et al. 2012), or 4×4.

    Args:
        path: Pose file.
        stamps_ns: (N,) times of the poses; without them pose i gets i nanoseconds, which only orders them.

    Raises:
        DataError: A line that is not twelve finite numbers, or another number of stamps than poses.
    """
    return _matrices(path, _rows(path), stamps_ns)


def _matrices(path: Path, lines: Iterable[tuple[int, list[str]]], stamps_ns: Stamps | None) -> Trajectory:
    """Return the poses of numbered lines of twelve numbers."""
    numbers: list[list[float]] = []
    for number, words in lines:
        try:
            row = [float(word) for word in words]
        except ValueError as error:
            raise DataError(f"{path}:{number}: {error}") from None
        if len(row) == 16 and row[12:] == _LAST_ROW:
            row = row[:12]
        if len(row) != 12 or not all(map(math.isfinite, row)):
            raise DataError(f"{path}:{number}: want 12 finite numbers, a row-major 3×4 pose")
        numbers.append(row)
    if not numbers:
        raise DataError(f"{path}: no poses; want lines of 12 numbers")
    stamps = np.arange(len(numbers), dtype=np.int64) if stamps_ns is None else stamps_ns
    if len(stamps) != len(numbers):
        raise DataError(
            f"{path}: {len(numbers)} poses but {len(stamps)} stamps; the two must pair line by line"
        )
    rows = np.reshape(numbers, (-1, 3, 4))
    R, t = rows[..., :3], rows[..., 3]
    T = transform(R, t)
    if not is_rigid(T, tolerance=1e-4):
        raise DataError(f"{path}: a pose is not a rigid motion; is this really KITTI's pose format?")
    return Trajectory(stamps, pose_of_row(row_of_pose(T)))  # text of few digits is slightly off SO(3)


def has_poses(path: Path) -> bool:
    """Return whether a file's first line is a stamp and a pose or a position."""
    with suppress(DataError):
        return is_mulran(path) or is_tum(path)
    return False


def is_tum(path: Path) -> bool:
    """Return whether a file's first line is what `read_tum` reads.

    Raises:
        DataError: The file cannot be read.
    """
    _, words = next(tum_rows(path), (0, []))
    return len(words) in (len(POSITION_COLUMNS), len(POSE_COLUMNS))


def is_mulran(path: Path) -> bool:
    """Return whether a file begins as MulRan's ``global_pose.csv``: whole nanoseconds and a 3×4 pose."""
    _, words = next(iter(_rows(path)), (0, []))
    return len(words) == _MULRAN_COLUMNS and words[0].isdigit()


def read_mulran(path: Path) -> Trajectory:
    """Read lines of nanoseconds and a row-major 3×4 matrix (Kim et al. 2020). Equal stamps count once.

    Raises:
        DataError: A line that is not a stamp and twelve finite numbers, or stamps that decrease.
    """
    stamps_ns: list[int] = []
    poses: list[tuple[int, list[str]]] = []
    for number, words in _rows(path):
        if len(words) != _MULRAN_COLUMNS or not words[0].isdigit():
            raise DataError(f"{path}:{number}: want whole nanoseconds and 12 numbers, a row-major 3×4 pose")
        stamp_ns = int(words[0])
        if stamps_ns and stamp_ns < stamps_ns[-1]:
            raise DataError(f"{path}:{number}: stamp {words[0]} comes before the line above; sort the file")
        if not stamps_ns or stamp_ns > stamps_ns[-1]:
            stamps_ns.append(stamp_ns)
            poses.append((number, words[1:]))
    return _matrices(path, poses, np.array(stamps_ns, dtype=np.int64))


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write one row-major 3×4 matrix a line, with every digit; KITTI text has no stamps."""
    rows = (" ".join(repr(float(v)) for v in T[:3].ravel()) for T in trajectory.T_world_body)
    write_text(path, "\n".join(rows) + "\n")


def tum_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the words of each line with a pose, in TUM's units and order; see `read_tum`.

    Raises:
        DataError: The file cannot be read, or a line begins as EuRoC's and has no unit quaternion.
    """
    columns, unit = list[int](), ""
    has_begun = False
    for number, line in enumerate(read_text(path, may_be_pipe=True).splitlines(), start=1):
        words = _words(line)
        is_comment = bool(words) and words[0].startswith(("#", "%"))
        if not has_begun and (is_comment or not any(map(_NUMBER.match, words))):
            if found := _columns_of(line):
                columns, unit = found, _stamp_unit(line)
        elif words and not is_comment:
            if columns and max(columns) < len(words):
                words = _picked(words, columns, unit)
            elif _EUROC.match(line) is not None and len(words) >= len(POSE_COLUMNS):
                _refuse_another_csv(f"{path}:{number}", words)
                words = [f"{words[0]}e-9", *words[1:4], *words[5:8], words[4]]
            elif len(words) == _NCLT_COLUMNS and epoch_ns(words[0]) is not None:
                words = words[: len(POSITION_COLUMNS)]
            yield number, words
        has_begun = has_begun or (bool(words) and not is_comment)


def _columns_of(header: str) -> list[int]:
    """Return the columns of stamp, x y z, and, where they are there, the quaternion and nanoseconds."""
    separator = next((one for one in ",;\t" if one in header), None)
    names = [
        re.sub(r"[\[(].*|\s", "", name.strip(" #%\"'").lower())
        for name in header.strip().lstrip("#%").strip().split(separator)
    ]
    patterns = dict(_COLUMNS)
    if not any(re.fullmatch(patterns["x"], name) for name in names):
        patterns |= _OF_MAPS
    at = {
        role: next((k for k, name in enumerate(names) if re.fullmatch(pattern, name)), None)
        for role, pattern in patterns.items()
    }
    found = {role: k for role, k in at.items() if k is not None}
    if not {"stamp", "x", "y", "z"} <= found.keys():
        return []
    turns = [found[role] for role in ("qx", "qy", "qz", "qw") if role in found]
    nanoseconds = [found["nanoseconds"]] if "nanoseconds" in found else []
    return [
        *(found[role] for role in ("stamp", "x", "y", "z")),
        *(turns if len(turns) == 4 else []),
        *nanoseconds,
    ]


def _stamp_unit(header: str) -> str:
    unit = _STAMP_UNIT.search(header)
    return "" if unit is None else unit[1]


def _picked(words: list[str], columns: list[int], unit: str) -> list[str]:
    """Return stamp, position and perhaps quaternion of a row by the header's columns and unit of stamps."""
    stamp, *numbers = (words[k] for k in columns)
    if len(columns) in (len(POSITION_COLUMNS) + 1, len(POSE_COLUMNS) + 1):
        stamp = f"{stamp}.{numbers.pop():0>9}"
    elif unit and epoch_ns(stamp) is None:
        stamp = f"{stamp}e-{_DIGITS[unit]}"
    return [stamp, *numbers]


def _refuse_another_csv(place: str, words: list[str]) -> None:
    """Refuse a line that begins as EuRoC's does, but has no unit quaternion where that has one.

    Raises:
        DataError: It is such a line.
    """
    try:
        length = math.hypot(*map(float, words[4:8]))
    except ValueError:
        return  # the caller names the word that is no number
    if abs(length - 1.0) > ROUNDING:
        raise DataError(
            f"{place}: columns 5 to 8 have length {length:.4g}; want EuRoC's unit quaternion, w first"
        )


def _rows(path: Path) -> Iterable[tuple[int, list[str]]]:
    for number, line in enumerate(read_text(path, may_be_pipe=True).splitlines(), start=1):
        words = _words(line)
        if words and not words[0].startswith("#"):
            yield number, words


def _words(line: str) -> list[str]:
    """Return the words of a line, separated by blanks, commas or semicolons; decimal commas become points."""
    words = line.replace(";", " ").split()
    if len(words) > 1 and any("," in word for word in words) and all(map(_DECIMAL_COMMA.fullmatch, words)):
        return [word.replace(",", ".") for word in words]
    return " ".join(words).replace(",", " ").split()
