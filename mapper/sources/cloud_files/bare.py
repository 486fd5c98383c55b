"""Clouds in files that hold little else: KITTI's records, numpy arrays and columns of text."""

import re
from io import StringIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError
from mapper.runtime.regular_files import HEAD_BYTES
from mapper.sources.cloud_files.parsing import (
    HEADER_LINES,
    MAX_RANGE_M,
    MIN_POINTS,
    SAMPLES,
    Column,
    Columns,
    load_array,
    refusing_damage,
)

KITTIS = 4
"""Width of records of x y z intensity, in float32."""
_FLOAT32 = np.dtype("<f4")
_MAX_CLASS = 1000
_NAMES = ("x", "y", "z", "intensity", "ring", "time")
_WITH_INTENSITY, _WITH_RINGS = (KITTIS, 5), (5, 6)
"""Widths of records that are the first of these: KITTI's, and nuScenes' and Boreas' with rings."""
_MOST_RINGS, _LONGEST_S = 256, 1.0
_WIDE_M = 10.0
_NCLT = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
_NCLT_UNIT_M, _NCLT_ORIGIN_M, _NCLT_LASERS = 0.005, 100.0, 32
_LEAST_FLOAT, _MOST_FLOAT, _MOST_STRANGE = 1e-12, 1e6, 0.1
"""Sizes of float32 in a cloud's file, other than 0, and the share of others from which they are none."""
EMPTY = "the file is empty"
_VELOVIEW = re.compile(r"points\w*:(?P<axis>[012])")
_IN_METRES = re.compile(r"(?P<axis>[xyz])[_([]*m[)\]]?")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*([eE][-+]?\d+)?|\.\d+([eE][-+]?\d+)?|nan|inf)", re.IGNORECASE)
_WIDTHS = (3, 5, 6, 7, 8)  # x y z; with intensity and ring (nuScenes); with a time; with padding (PCL)
_BLOCKS, _BLOCK_NUMBERS = 8, 3360  # in parts of whole records of every width up to 8
_LEAST_STEP = 0.01
_BETTER, _BETTER_OF_EIGHT = 0.2, 1.2
"""Difference of logarithms of steps that shows other records: those of the right width were smaller by 0.3 in
shuffled clouds and by 1.5 to 4 in sweeps; where upper and lower rings take turns, those of eight
by 0.6, of padded ones by 2.5."""
_ALIKE_RATIO = 2.0
_LEAST_INTENSITY, _MAX_NEGATIVE_RATIO = -1.0, 0.01
"""Coordinates are below it; times before the end of the sweep, in seconds, are not."""


def read_bin(path: Path, columns: int | None = None) -> Columns:
    """Read records of float32 that begin with x y z.

    Args:
        path: The file.
        columns: Numbers of a record; None is the four of KITTI (Geiger et al. 2013), and checked, or five or
            six with the numbers of rings.

    Raises:
        FrameError: The file is not a whole number of records, or of other ones.
    """
    size = path.stat().st_size
    if columns is None and (of_nclt := _nclt_columns(path, size)):
        return of_nclt
    numbers = np.fromfile(path, _FLOAT32) if size % _FLOAT32.itemsize == 0 else np.empty(0, _FLOAT32)
    is_by_column = columns is None and len(numbers) % KITTIS == 0 and _is_by_column(numbers)
    if columns is None and not is_by_column and (other := other_width(numbers)):
        width, is_certain = other
        if is_certain and _has_rings(numbers.reshape(-1, width)):
            columns = width
        elif is_certain:
            doubles = ", unless they are 4 float64: save these as .npy" if width == 8 else ""
            raise FrameError(
                f"{path}: records of {width} float32, not KITTI's 4 (x y z intensity); "
                f"--set source.bin_columns={width} takes the first 3 for x y z{doubles}"
            )
        else:
            raise FrameError(
                f"{path}: every fourth float32 is negative as coordinates are, not as KITTI's intensities; "
                f"--set source.bin_columns={width} if records have {width}, or {KITTIS} if they have 4"
            )
    record_bytes = (columns or KITTIS) * _FLOAT32.itemsize
    if size % record_bytes:
        what = "KITTI's float32 x y z intensity" if columns is None else f"{columns} float32"
        raise FrameError(
            f"{path}: {size} bytes, want a multiple of {record_bytes}, {what}; copy it again if it was cut, "
            "else --set source.bin_columns to the numbers of a record"
        )
    records = numbers.reshape(KITTIS, -1).T if is_by_column else numbers.reshape(-1, columns or KITTIS)
    _refuse_others_first(records, path)
    known = len(_NAMES) if _has_rings(records) else KITTIS if records.shape[1] in _WITH_INTENSITY else 3
    return dict(zip(_NAMES[:known], records.T, strict=False))


def _has_rings(records: Column) -> bool:
    """Return whether records are x y z, intensity, ring and perhaps time, by what these can be."""
    if records.shape[1] not in _WITH_RINGS:
        return False
    intensities, rings, *times = records[:, 3:].T
    return bool(
        (intensities >= 0.0).all()
        and (rings == np.rint(rings)).all()
        and 0.0 <= rings.min() < rings.max() < _MOST_RINGS
        and all(np.abs(one).max() <= _LONGEST_S for one in times)
    )


def _is_by_column(numbers: NDArray[np.float32]) -> bool:
    """Return whether all x come first, then all y, z and intensities, as in the Oxford RobotCar's files.

    Intensities are not negative, as no quarter of a file of records is.
    """
    if len(numbers) < 10 * MIN_POINTS * KITTIS:
        return False
    *coordinates, intensities = numbers.reshape(KITTIS, -1)
    if (intensities < 0.0).any():
        return False
    return max(float((column < 0.0).mean()) for column in coordinates) > _MAX_NEGATIVE_RATIO


def _nclt_columns(path: Path, size: int) -> Columns | None:
    """Return the columns of NCLT's file (Carlevaris-Bianco et al. 2016), turned upright; None of another.

    A record is x forward, y right, z down in 5 mm from -100 m on, intensity, and number of the laser.
    """
    if size % _NCLT.itemsize or not size:
        return None
    records = np.fromfile(path, _NCLT)
    if records["laser"].max() >= _NCLT_LASERS:
        return None
    floats = np.abs(records[: len(records) // 2 * 2].view(_FLOAT32))
    with np.errstate(invalid="ignore"):
        is_strange = ~((floats == 0.0) | ((floats > _LEAST_FLOAT) & (floats < _MOST_FLOAT)))
    if is_strange.mean() < _MOST_STRANGE:
        return None
    x, y, z = (records["xyz"].astype(np.float32) * np.float32(_NCLT_UNIT_M) - np.float32(_NCLT_ORIGIN_M)).T
    return {"x": x, "y": -y, "z": -z, "intensity": records["intensity"]}


def _refuse_others_first(table: Column, path: Path) -> None:
    """Refuse (N, ≥ 3) numbers of which the first are in a narrow range above 0, and the next two are not."""
    first, others = table[:, 0], table[:, 1:3]
    is_narrow = len(first) > 0 and first.min() >= 0.0 and 0.0 < first.max() <= 1.0
    if is_narrow and np.ptp(others, axis=0).min() > _WIDE_M:
        raise FrameError(
            f"{path}: the first number of every point is 0 to 1 as an intensity or a time is, and no "
            "coordinate; want x y z first, or a header with the columns' names in a text file"
        )


def read_npy(path: Path) -> Columns:
    """Read a numpy array: structured with fields x, y, z, or (…, ≥ 3) numbers that begin with them.

    Raises:
        FrameError: It is neither, or not an array's file.
    """
    with path.open("rb") as stream:
        array = load_array(stream, path)
    if array.dtype.names:
        return {name: array[name].ravel() for name in array.dtype.names if array[name].shape == array.shape}
    if array.ndim < 2 or array.shape[-1] < 3 or array.dtype.kind not in "fiu":
        raise FrameError(f"{path}: {array.dtype} of shape {array.shape}, want numbers, (N, 3) or wider")
    if array.ndim == 2 and len(array) < MIN_POINTS <= array.shape[1]:
        array = array.T  # a row of each coordinate
    return _xyz(array.reshape(-1, array.shape[-1]), path)


def read_text(path: Path) -> Columns:
    """Read lines of x y z …, separated by blanks, commas or semicolons; beside these a comma may be decimal.

    A header with as many names as there are columns says which are x, y and z; else they are the first.

    Raises:
        FrameError: It is not text, or its lines are not as many numbers each, three or more.
    """
    try:
        text = _in_blanks(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError:
        raise FrameError(f"{path}: not a text file") from None
    names, skipped = _header(text)
    if skipped is None:
        raise FrameError(f"{path}: none of the first {HEADER_LINES} lines is three or more numbers: x y z")
    with refusing_damage(path, what="text"):
        values = np.loadtxt(StringIO(text), skiprows=skipped, ndmin=2)
    if len(names) == values.shape[1]:
        return {name: values[:, column] for column, name in enumerate(names)}
    if {"x", "y", "z"} <= set(names) and names[:3] != ["x", "y", "z"]:
        raise FrameError(
            f"{path}: a header of {len(names)} names, but {values.shape[1]} columns; want as many"
        )
    return _xyz(values, path)


def _in_blanks(text: str) -> str:
    """Return lines whose words are separated by blanks, with decimal points; names of two words are one."""
    begin = 0
    for _ in range(HEADER_LINES):
        end = text.find("\n", begin)
        if end < 0 or _NUMBER.match(text, begin):
            break
        begin = end + 1
    header = [
        re.sub(r"(?<=[^\s,;]) +(?=[^\s,;])", "_", line) if re.search("[,;\t]", line) else line
        for line in text[:begin].split("\n")
    ]
    is_decimal = ";" in text and "." not in text
    text = "\n".join(header) + text[begin:]
    return text.replace(",", "." if is_decimal else " ").replace(";", " ")


def why_no_points(path: Path) -> str | None:
    """Return why the first lines of a text file cannot be points; None where they can.

    Labels of objects, which are text files with numbered names too, have words in their lines, fewer lines
    than a cloud has points, or a class as the first column.
    """
    try:
        with path.open("rb") as stream:
            head, is_cut = stream.read(HEAD_BYTES), bool(stream.read(1))
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    text = _in_blanks(head.decode("utf-8-sig", errors="replace"))
    text = text.replace("\r\n", "\n").replace("\r", "\n")  # as text files are read
    lines = text.split("\n")[: -1 if is_cut else None]
    names, skipped = _header(text)
    if skipped is None:
        first = next((line.strip() for line in lines if line.strip()), "")
        return f"{first!r} is not three or more numbers" if first else EMPTY
    rows = [line.split() for line in lines[skipped:] if line.strip()]
    if wrong := next((row for row in rows if len(row) < 3 or not all(map(_NUMBER.fullmatch, row))), None):
        return f"{' '.join(wrong)!r} is not three or more numbers"
    if len(rows) < MIN_POINTS and not is_cut:
        return f"{len(rows)} lines, want {MIN_POINTS} points or more"
    if {"x", "y", "z"} <= set(names):
        return None
    x, *others = np.array([row[:3] for row in rows], dtype=np.float64).T
    is_class = bool(((x == np.rint(x)) & (x >= 0.0) & (x < _MAX_CLASS)).all())
    if is_class and any((other != np.rint(other)).any() for other in others):
        return "the first column holds whole numbers only, as classes of objects do"
    return None


def _header(text: str) -> tuple[list[str], int | None]:
    """Return the columns' names, if a header has them, and the number of lines before the first point."""
    names: list[str] = []
    for number, line in enumerate(text.split("\n", HEADER_LINES)[:HEADER_LINES]):
        words = line.split()
        if len(words) >= 3 and all(_NUMBER.fullmatch(word) for word in words):
            return names, number
        bare = [_column_name(word) for word in words if word.strip('"#/')]
        if {"x", "y", "z"} <= set(bare) or not line.startswith(("#", "//")):
            names = bare
    return names, None


def _column_name(word: str) -> str:
    """Return a word of a header in lower case, x y z for VeloView's Points_m_XYZ:0, x_m, x[m] and so on."""
    name = word.strip('"#/').lower()
    if found := _VELOVIEW.fullmatch(name):
        return "xyz"[int(found["axis"])]
    return found["axis"] if (found := _IN_METRES.fullmatch(name)) else name


def _xyz(table: Column, path: Path) -> Columns:
    _refuse_others_first(table, path)
    return {name: table[:, column] for column, name in enumerate("xyz")}


def other_width(numbers: NDArray[np.float32]) -> tuple[int, bool] | None:
    """Return the width that a file's numbers have if it is not KITTI's, and whether they leave no doubt.

    From record to record each column advances little beside the steps from one column to another, or in
    shuffled clouds at least has a spread of its own. Where no width shows, columns that should be intensities
    but have coordinates' signs are in doubt.

    Args:
        numbers: (N,) all of the file.
    """
    fitting = [width for width in _WIDTHS if len(numbers) % width == 0 and len(numbers) >= 2 * width]
    if not fitting:
        return None
    step = _usual_step(numbers, KITTIS)
    gains = {
        width: step - _usual_step(numbers, width) - (_BETTER_OF_EIGHT if width == 8 else _BETTER)
        for width in fitting
    }
    best = max(fitting, key=lambda width: (gains[width], -width))
    if best == 6 and _are_halves_alike(numbers.reshape(-1, 6)):
        best = 3
    if gains[best] > 0.0:
        return best, True
    if len(numbers) % KITTIS or gains[best] < -2.0 * _BETTER:
        return None
    negative = (numbers[KITTIS - 1 :: KITTIS] < _LEAST_INTENSITY).mean()
    return (best, False) if negative > _MAX_NEGATIVE_RATIO else None


def _are_halves_alike(records: NDArray[np.float32]) -> bool:
    """Return whether records of six are two of x y z: their columns spread as far as those three later."""
    sample = _within_range(records[:: 1 + len(records) // SAMPLES])
    spreads = _LEAST_STEP + sample.std(axis=0)
    return bool(np.abs(np.log(spreads[:3] / spreads[3:])).max() < np.log(_ALIKE_RATIO))


def _within_range(numbers: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return numbers that are no ranges, or none, as the largest range: constant columns take no steps."""
    return np.nan_to_num(numbers, nan=MAX_RANGE_M).clip(-MAX_RANGE_M, MAX_RANGE_M)


def _usual_step(numbers: NDArray[np.float32], width: int) -> float:
    """Return the mean over the columns of the logarithm of their mean step from record to record."""
    starts = np.linspace(0, max(len(numbers) - _BLOCK_NUMBERS, 0), _BLOCKS) // _BLOCK_NUMBERS * _BLOCK_NUMBERS
    total, count = np.zeros(width), 0
    for start in np.unique(starts.astype(int)):
        block = _within_range(numbers[start : start + _BLOCK_NUMBERS])
        rows = block[: len(block) // width * width].reshape(-1, width).astype(np.float64)
        total += np.abs(np.diff(rows, axis=0)).sum(axis=0)
        count += len(rows) - 1
    return float(np.log(_LEAST_STEP + total / max(count, 1)).mean())
