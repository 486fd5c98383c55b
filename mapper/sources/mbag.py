"""mbag: the thesis's unified text format of RGB-D logs (A12, thesis §3.5).

Two header lines, ``!RAWLOG FB1`` and ``!dbName: desk``, then one line a frame:
``timestamp; rgb; depth; x; y; z; qx; qy; qz; qw``. Paths are relative to the file. A frame without ground
truth has ``nan`` (or nothing) in all seven pose fields, or ends after the depth image.
"""

import re
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import Transform
from mapper.core.timebase import ns_from_seconds_text
from mapper.sources.calibration import freiburg_camera
from mapper.sources.config import SourceConfig
from mapper.sources.rgbd import RgbdLog, Shot, entries_of, find_calibration, present, read_accelerations
from mapper.sources.text import (
    parse_numbers,
    parse_stamp,
    pose_from_numbers,
    read_lines,
    rows,
    time_order,
    truth_from,
)

DEPTH_UNITS_PER_M = 5000.0
HEADER = "!RAWLOG FB1"
LOOKED_FOR = "one .mbag file"

_MISSING = ("", "nan")
_STAMP_NAME = re.compile(r"\d+\.\d+")


def recognise(path: Path) -> bool:
    """Tell whether a path is an mbag file, or a folder with exactly one."""
    return _mbag_file(path) is not None


def open_log(path: Path, config: SourceConfig) -> RgbdLog:
    """Open an mbag file, or the one in a folder.

    Raises:
        SourceError: The file is empty or malformed, none of its images exists, or the camera is unknown.
    """
    file = _mbag_file(path)
    if file is None:
        raise SourceError(f"{path}: want {LOOKED_FOR}")
    name = _name_of(file)
    shots: list[Shot] = []
    poses: list[tuple[int, Transform | None]] = []
    for number, words in rows(file, separator=";"):
        shot, pose_words = _parse(file, number, words)
        shots.append(shot)
        if any(word.lower() not in _MISSING for word in pose_words):
            numbers = parse_numbers([word or "nan" for word in pose_words], where=f"{file}:{number}")
            poses.append((shot.stamp_ns, pose_from_numbers(numbers)))
    if not shots:
        raise SourceError(f"{file}: empty list; want lines of timestamp; rgb; depth; x; y; z; qx; qy; qz; qw")
    shots, notes = _usable(file, shots)
    calibration, units_per_m = find_calibration(
        file.parent,
        config.camera,
        known=freiburg_camera(name, file.stem),
        depth_units_per_m=DEPTH_UNITS_PER_M,
    )
    truth, truth_notes = truth_from(poses, what=file.name) if poses else (None, [])
    accelerations, acceleration_notes = read_accelerations(file.parent)
    return RgbdLog(
        path=path,
        name=name,
        kind="mbag",
        truth=truth,
        accelerations=accelerations,
        notes=[*notes, *truth_notes, *acceleration_notes],
        images=entries_of(shots, calibration, depth_units_per_m=units_per_m),
    )


def _mbag_file(path: Path) -> Path | None:
    if path.suffix.lower() == ".mbag" and path.is_file():
        return path
    found = sorted(path.glob("*.mbag"))
    return found[0] if len(found) == 1 else None


def _name_of(file: Path) -> str:
    """Return the data base's name; the header must say that this is an mbag file at all."""
    header = [line.strip() for line in read_lines(file) if line.lstrip().startswith("!")]
    if not header or header[0] != HEADER:
        raise SourceError(f"{file}: does not start with {HEADER!r}; is this an mbag file?")
    names = (re.fullmatch(r"!\s*dbName\s*:\s*(.+)", line) for line in header)
    return next((found[1] for found in names if found), file.stem)


def _parse(file: Path, number: int, words: list[str]) -> tuple[Shot, list[str]]:
    where = f"{file}:{number}"
    if len(words) not in (3, 10):
        raise SourceError(f"{where}: {len(words)} fields, want 10: timestamp; rgb; depth; x … qw")
    stamp_ns = parse_stamp(words[0], where=where)
    # The thesis's own recordings were made on Windows.
    colour, depth = (file.parent / word.replace("\\", "/") for word in words[1:3])
    # The format has one stamp a line; an image named by its stamp, as TUM's are, still tells its own.
    depth_stamp_ns = ns_from_seconds_text(depth.stem) if _STAMP_NAME.fullmatch(depth.stem) else stamp_ns
    return Shot(stamp_ns, colour, depth_stamp_ns, depth), words[3:]


def _usable(file: Path, shots: list[Shot]) -> tuple[list[Shot], list[str]]:
    """Return the shots whose two images exist, in time order."""
    has_colour = present(shot.colour for shot in shots)
    has_depth = present(shot.depth for shot in shots)
    kept = [shot for shot, *has in zip(shots, has_colour, has_depth, strict=True) if all(has)]
    if not kept:
        raise SourceError(
            f"{file}: none of its {len(shots)} pairs of images exists; the first: {shots[0].colour}"
        )
    notes = []
    if len(kept) < len(shots):
        notes.append(
            f"{file.name}: {len(shots) - len(kept)} of {len(shots)} listed pairs do not exist; dropped"
        )
    order, order_notes = time_order(np.array([shot.stamp_ns for shot in kept]), what=file.name)
    return [kept[i] for i in order], [*notes, *order_notes]
