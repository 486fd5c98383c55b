"""Poznań folders: numbered images and true poses ``number x y z roll pitch yaw`` (Somlyai, PhD thesis, §3.5).

Images lie in ``rgb/`` and ``depth/`` (``rgb_0.png``, ``depth_0.png``, with or without leading zeros) or side
by side. The truth is the text file with "ground" or "gt" in its name and rows of seven columns, the first an
image number. Positions are metres. Angles are degrees if a comment line says "deg", radians if
it says "rad"; without either they are degrees if any exceeds a full turn of 2π, radians if none does.
"""

import math
import re
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import Transform, transform
from mapper.core.rotations import rotation_from_euler
from mapper.core.trajectory import Trajectory
from mapper.core.units import MM_PER_M
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.image_folders.numbered import find_images, stamped
from mapper.sources.image_folders.pairing import ordered_pairs
from mapper.sources.image_folders.rgbd import find_calibration, rgbd_log
from mapper.sources.scan_stamps import stamp_at
from mapper.sources.text import parse_count, parse_numbers, read_lines, rows, truth_from

RATE_HZ = 10.0  # "every 100 ms", Somlyai (PhD thesis), §5.6
LOOKED_FOR = "groundtruth.txt of number x y z roll pitch yaw with numbered images (Poznań)"

_TRUTH_NAME = re.compile(r"ground|(?:^|[^a-z])gt(?:[^a-z]|$)", re.IGNORECASE)


def recognise(path: Path) -> bool:
    """Return whether a path is a folder of numbered images with a truth of seven columns."""
    return _truth_file(path) is not None and find_images(path) is not None


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a Poznań folder.

    Raises:
        SourceError: Images or truth are missing or malformed, or the camera is unknown.
    """
    images, truth_path = find_images(path), _truth_file(path)
    if images is None or truth_path is None:
        raise SourceError(f"{path}: not a Poznań log; want {LOOKED_FOR}")
    rate_hz = config.rate_hz or RATE_HZ
    pairs, stamp_notes = stamped(images.pairs, rate_hz=config.rate_hz, usual_hz=RATE_HZ)
    ordered, order_notes = ordered_pairs(pairs, config, what="image names", path=path)
    stamps_ns = {image.number: pair.stamp_ns for image, pair in zip(images.pairs, pairs, strict=True)}
    return rgbd_log(
        ordered,
        find_calibration(path, config.camera, known=None),
        depth_units_per_m=MM_PER_M,
        path=path,
        name=path.resolve().name,
        kind="poznan",
        truth=_read_truth(truth_path, stamps_ns, rate_hz=rate_hz),
        notes=[*images.notes, *stamp_notes, *order_notes],
    )


def _truth_file(folder: Path) -> Path | None:
    for path in sorted(folder.glob("*.txt")):
        if _TRUTH_NAME.search(path.stem):
            first = next((words for _, words in rows(path)), [])
            if len(first) == 7 and first[0].isdecimal():
                return path
    return None


def _read_truth(
    path: Path, stamps_ns: dict[int, int], *, rate_hz: float
) -> tuple[Trajectory | None, list[str]]:
    numbers, values = [], []
    for line, words in rows(path):
        where = f"{path}:{line}"
        if len(words) != 7:
            raise SourceError(f"{where}: {' '.join(words)!r}, want: number x y z roll pitch yaw")
        numbers.append(parse_count(words[0], where=where))
        values.append(parse_numbers(words[1:], where=where))
    table = np.array(values)
    in_degrees = _in_degrees(path, table[:, 3:])
    note = f"{path.name}: angles taken as {'degrees' if in_degrees else 'radians'}"
    poses: list[tuple[int, Transform | None]] = []
    for number, row in zip(numbers, table, strict=True):
        stamp_ns = stamps_ns.get(number, stamp_at(number, rate_hz=rate_hz))
        roll, pitch, yaw = np.deg2rad(row[3:]) if in_degrees else row[3:]
        is_pose = np.isfinite(row).all()
        T = transform(rotation_from_euler(roll, pitch, yaw), row[:3]) if is_pose else None
        poses.append((stamp_ns, T))
    truth, notes = truth_from(poses, what=path.name)
    return truth, [note, *notes]


def _in_degrees(path: Path, angles: np.ndarray) -> bool:
    header = " ".join(line for line in read_lines(path) if line.lstrip().startswith(("#", "!")))
    if unit := re.search(r"\b(?:deg|rad)", header, re.IGNORECASE):
        return unit[0].lower() == "deg"
    return bool((np.abs(angles[np.isfinite(angles)]) > 2.0 * math.pi).any())
