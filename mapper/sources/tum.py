"""TUM RGB-D folders: rgb.txt, depth.txt, groundtruth.txt (Sturm et al. 2012)."""

import math
import re
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.trajectory import Trajectory
from mapper.sources.base import Log
from mapper.sources.calibration import freiburg_camera
from mapper.sources.config import SourceConfig
from mapper.sources.listed_files import present, within
from mapper.sources.pairing import ImageList, pair_images
from mapper.sources.rgbd import find_calibration, rgbd_log
from mapper.sources.text import (
    parse_numbers,
    parse_stamp,
    poses_from_numbers,
    read_lines,
    table,
    time_order,
    truth_from,
)

DEPTH_UNITS_PER_M = 5000.0


def recognise(path: Path) -> bool:
    """Tell whether a path is a folder with TUM's list of colour images."""
    return (path / "rgb.txt").is_file()


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a TUM folder: each colour image with its nearest depth image.

    Raises:
        SourceError: A list is missing, empty or malformed, an image lies outside of the folder, no two images
            pair, or the camera is unknown.
    """
    notes: list[str] = []
    colour = _read_list(path, "rgb.txt", notes)
    depth = _read_list(path, "depth.txt", notes)
    pairs, pair_notes = pair_images(colour, depth, config, path=path)
    name = _name_of(path)
    calibration, units_per_m = find_calibration(
        path,
        config.camera,
        known=freiburg_camera(path.resolve().name, name),
        depth_units_per_m=DEPTH_UNITS_PER_M,
    )
    truth, truth_notes = read_truth(path / "groundtruth.txt")
    return rgbd_log(
        pairs,
        calibration,
        depth_units_per_m=units_per_m,
        path=path,
        name=name,
        kind="tum",
        truth=truth,
        notes=[*notes, *pair_notes, *truth_notes],
    )


def read_truth(path: Path) -> tuple[Trajectory | None, list[str]]:
    """Return the truth in lines of ``stamp tx ty tz qx qy qz qw``, if any, and notes on dropped lines.

    Raises:
        SourceError: A line is not eight numbers.
    """
    if not path.is_file():
        return None, []
    stamps_ns, numbers = [], []
    for where, words in table(path, "stamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw"):
        row = parse_numbers(words, where=where)
        has_stamp = math.isfinite(row[0])
        stamps_ns.append(parse_stamp(words[0], where=where) if has_stamp else 0)
        numbers.append(row[1:] if has_stamp else np.full(7, np.nan))
    poses = poses_from_numbers(np.reshape(numbers, (-1, 7)))
    return truth_from(list(zip(stamps_ns, poses, strict=True)), what=path.name)


def _read_list(folder: Path, name: str, notes: list[str]) -> ImageList:
    """Read ``stamp filename`` lines in time order, without the files that do not exist."""
    path = folder / name
    stamps_ns, paths = [], []
    for where, words in table(path, "stamp", "filename"):
        stamps_ns.append(parse_stamp(words[0], where=where))
        paths.append(within(folder, words[1], where=where))
    if not paths:
        raise SourceError(f"{path}: empty list; want lines of: stamp filename")
    exists = present(paths)
    kept = [i for i, found in enumerate(exists) if found]
    if not kept:
        raise SourceError(f"{path}: none of its {len(paths)} images exists; the first is {paths[0]}")
    if len(kept) < len(paths):
        notes.append(f"{name}: {len(paths) - len(kept)} of {len(paths)} listed images do not exist; dropped")
    stamps = np.array([stamps_ns[i] for i in kept], dtype=np.int64)
    order, order_notes = time_order(stamps, what=name)
    notes.extend(order_notes)
    return ImageList(stamps[order], [paths[kept[i]] for i in order])


def _name_of(path: Path) -> str:
    """Return the recording that TUM's list names, ``# file: 'rgbd_…_xyz.bag'``, or else the folder."""
    for line in read_lines(path / "rgb.txt"):
        if not line.startswith("#"):
            break
        if found := re.match(r"#\s*file:\s*'(.+)'", line):
            return found[1]
    return path.resolve().name
