"""mbag: the unified text format of RGB-D logs of Somlyai (PhD thesis, §3.5).

Two header lines, ``!RAWLOG FB1`` and ``!dbName: desk``, then one line a frame:
``timestamp; rgb; depth; x; y; z; qx; qy; qz; qw``. Paths are relative to the file. A frame without ground
truth has ``nan`` (or nothing) in all seven pose fields, or ends after the depth image.
"""

import re
from pathlib import Path

from mapper.core.errors import SourceError
from mapper.core.geometry import Transform
from mapper.core.timebase import ns_from_seconds_text
from mapper.sources.base import Log
from mapper.sources.calibration import freiburg_camera
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.reading import TUM_UNITS_PER_M
from mapper.sources.image_folders.pairing import usable_pairs
from mapper.sources.image_folders.rgbd import FramePair, find_calibration, rgbd_log
from mapper.sources.listed_files import within
from mapper.sources.text import (
    parse_numbers,
    parse_stamp,
    pose_from_numbers,
    read_lines,
    rows,
    truth_from,
)

HEADER = "!RAWLOG FB1"
LOOKED_FOR = "one .mbag file"

_MISSING = ("", "nan")
_STAMP_NAME = re.compile(r"\d+\.\d+")


def recognise(path: Path) -> bool:
    """Return whether a path is an mbag file, or a folder with exactly one."""
    return _mbag_file(path) is not None


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of an mbag file, or of the one in a folder.

    Raises:
        SourceError: The file is empty or malformed, an image lies outside of its folder, none exists, or the
            camera is unknown.
    """
    file = _mbag_file(path)
    if file is None:
        raise SourceError(f"{path}: want {LOOKED_FOR}")
    name = _name_of(file)
    pairs: list[FramePair] = []
    poses: list[tuple[int, Transform | None]] = []
    for number, words in rows(file, separator=";"):
        pair, pose_words = _parse(file, number, words)
        pairs.append(pair)
        if any(word.lower() not in _MISSING for word in pose_words):
            numbers = parse_numbers([word or "nan" for word in pose_words], where=f"{file}:{number}")
            poses.append((pair.stamp_ns, pose_from_numbers(numbers)))
    if not pairs:
        raise SourceError(f"{file}: empty list; want lines of timestamp; rgb; depth; x; y; z; qx; qy; qz; qw")
    found, notes = usable_pairs(pairs, config, listed_in=file)
    known = freiburg_camera(name, file.stem)
    return rgbd_log(
        found,
        find_calibration(file.parent, config.camera, known=known),
        depth_units_per_m=TUM_UNITS_PER_M,
        path=path,
        name=name,
        kind="mbag",
        truth=truth_from(poses, what=file.name) if poses else (None, []),
        notes=notes,
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


def _parse(file: Path, number: int, words: list[str]) -> tuple[FramePair, list[str]]:
    where = f"{file}:{number}"
    if len(words) not in (3, 10):
        raise SourceError(f"{where}: {len(words)} fields, want 10: timestamp; rgb; depth; x … qw")
    stamp_ns = parse_stamp(words[0], where=where)
    # The thesis's own recordings were made on Windows.
    colour, depth = (within(file.parent, word.replace("\\", "/"), where=where) for word in words[1:3])
    # The format has one stamp a line; an image named by its stamp, as TUM's are, still has its own.
    depth_stamp_ns = ns_from_seconds_text(depth.stem) if _STAMP_NAME.fullmatch(depth.stem) else stamp_ns
    return FramePair(stamp_ns, colour, depth_stamp_ns, depth), words[3:]
