"""TUM RGB-D folders: rgb.txt, depth.txt, groundtruth.txt (Sturm et al. 2012).

Without these lists the pairs of associations.txt, or of another text of such lines, are read: ``stamp
rgb/name stamp depth/name``. OpenLORIS (Shi et al. 2020) calls the lists color.txt and aligned_depth.txt.
"""

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError, SourceError
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.core.units import MM_PER_M
from mapper.runtime.regular_files import HEAD_BYTES
from mapper.sources.base import Log
from mapper.sources.calibration import freiburg_camera
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.reading import TUM_UNITS_PER_M, has_floats
from mapper.sources.image_folders.pairing import ImageList, pair_images
from mapper.sources.image_folders.rgbd import find_calibration, rgbd_log
from mapper.sources.listed_files import present, within
from mapper.sources.scan_stamps import UNPADDED_NOTE, unpadded_stamps
from mapper.sources.text import (
    parse_numbers,
    parse_stamp,
    poses_from_numbers,
    read_lines,
    table,
    told_without_rotations,
    truth_from,
)
from mapper.sources.trajectory_files import tum_rows, whole_row

DEVICE_POSES = "device_poses.txt"
"""File of a phone's own poses in a converted log, as its groundtruth.txt."""
MILLIMETRES_NOTE = "depth taken to be in millimetres; if not, source.camera.depth_factor (TUM's is 5000)"
UNITS_NOTE = "depth taken as TUM's 5000 units a metre; source.camera.depth_factor=1000 reads millimetres"
METRES_NOTE = "depth of floats taken as metres; source.camera.depth_factor=1000 reads millimetres"
_LISTS = (("rgb.txt", "depth.txt"), ("color.txt", "aligned_depth.txt"))
"""Lists of colour and of depth images, of TUM and of OpenLORIS."""
_FEWEST_COUNTED = 10
"""Images a second apart, to the nanosecond, that are counted rather than timed."""
_BASE_NOTE = ("the truth of OpenLORIS is that of the robot's base, not of the camera",)
_IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".npy", ".exr", ".pfm")
_ASSOCIATIONS = ("associations.txt", "associated.txt", "association.txt", "associate.txt", "assoc.txt")


def recognise(path: Path) -> bool:
    """Return whether a path is a folder with TUM's list of colour images, or with a list of pairs."""
    return _lists(path) is not None or _associations(path) is not None


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a TUM folder: each colour image with its nearest depth image.

    Raises:
        SourceError: A list is missing, empty or malformed, an image lies outside of the folder, no two images
            pair, or the camera is unknown.
    """
    notes: list[str] = []
    name = path.resolve().name
    lists, units_per_m = _lists(path) or _LISTS[0], TUM_UNITS_PER_M
    if (associations := _associations(path)) and not (path / lists[0]).is_file():
        colour, depth = _read_associations(associations, notes)
    else:
        colour, depth = (_read_list(path, one, notes) for one in lists)
        name = _name_of(path / lists[0])
        units_per_m = TUM_UNITS_PER_M if lists == _LISTS[0] else MM_PER_M
    log = log_of_images(path, colour, depth, config, depth_units_per_m=units_per_m, name=name, notes=notes)
    if lists == _LISTS[0]:
        return log
    return replace(log, kind="openloris", notes=[*log.notes, *_BASE_NOTE] if log.truth else log.notes)


def log_of_images(
    path: Path,
    colour: ImageList,
    depth: ImageList,
    config: SourceConfig,
    *,
    depth_units_per_m: float,
    name: str,
    notes: Sequence[str],
) -> Log:
    """Return the log of images by their stamps, with the truth of TUM's groundtruth.txt.

    Args:
        path: Folder of the log.
        colour: Colour images.
        depth: Depth images.
        config: Pairing and camera.
        depth_units_per_m: Depth image units per metre, where nothing states them.
        name: Name, as of :class:`Log`.
        notes: Sentences on what finding the images left out.

    Raises:
        SourceError: As :func:`read_log`.
    """
    pairs, pair_notes = pair_images(colour, depth, config, path=path)
    if len(colour.stamps_ns) >= _FEWEST_COUNTED and (np.diff(colour.stamps_ns) == NS_PER_S).all():
        first, second = (stamps_ns / NS_PER_S for stamps_ns in colour.stamps_ns[:2].tolist())
        pair_notes.append(
            f"stamps are {first:.9g}, {second:.9g} …, taken as seconds; if they count frames, leave "
            "the lists out: images are then paired by the numbers in their names, source.rate_hz a second"
        )
    known = freiburg_camera(path.resolve().name, name)
    calibration = find_calibration(path, config.camera, known=known)
    are_units_assumed = known is None and calibration.depth_units_per_m is None
    if are_units_assumed:
        millimetres_or_tum = MILLIMETRES_NOTE if depth_units_per_m == MM_PER_M else UNITS_NOTE
        pair_notes.append(METRES_NOTE if has_floats(pairs[0].depth) else millimetres_or_tum)
    log = rgbd_log(
        pairs,
        calibration,
        depth_units_per_m=depth_units_per_m if known is None else TUM_UNITS_PER_M,
        path=path,
        name=name,
        kind="tum",
        truth=read_truth(path / "groundtruth.txt"),
        notes=[*notes, *pair_notes],
    )
    device_poses, _ = read_truth(path / DEVICE_POSES)
    return replace(log, are_units_assumed=are_units_assumed, device_poses=device_poses)


def read_truth(path: Path) -> tuple[Trajectory | None, list[str]]:
    """Return the truth in lines of ``stamp tx ty tz qx qy qz qw``, if any, and notes on dropped lines.

    Separators and order of the columns may be others, as of :func:`mapper.sources.trajectory_files.read_tum`.

    Raises:
        SourceError: A line is not eight numbers.
    """
    if not path.is_file():
        return None, []
    stamps_ns, numbers = [], []
    try:
        lines = list(tum_rows(path))
    except DataError as error:
        raise SourceError(f"{error}") from None
    for number, words in lines:
        where = f"{path}:{number}"
        try:
            words = whole_row(words, place=where)
        except DataError as error:
            raise SourceError(f"{error}") from None
        row = parse_numbers(words, where=where)
        has_stamp = math.isfinite(row[0])
        stamps_ns.append(parse_stamp(words[0], where=where) if has_stamp else 0)
        numbers.append(row[1:] if has_stamp else np.full(7, np.nan))
    poses = poses_from_numbers(np.reshape(numbers, (-1, 7)))
    truth, notes = truth_from(list(zip(stamps_ns, poses, strict=True)), what=path.name)
    return told_without_rotations(truth, notes, what=path.name)


def _read_list(folder: Path, name: str, notes: list[str]) -> ImageList:
    """Read ``stamp filename`` lines in time order, without the files that do not exist."""
    path = folder / name
    rows = [(where, *words) for where, words in table(path, "stamp", "filename")]
    return _images(folder, rows, notes, path=path)


def _lists(folder: Path) -> tuple[str, str] | None:
    return next((lists for lists in _LISTS if (folder / lists[0]).is_file()), None)


def _associations(folder: Path) -> Path | None:
    """Return the list of pairs in a folder, by its name, or by its first line, which names two images."""
    named = (folder / name for name in _ASSOCIATIONS)
    if not folder.is_dir():
        return None
    return next(filter(Path.is_file, named), None) or next(
        (path for path in sorted(folder.glob("*.txt")) if path.is_file() and _pairs_images(path)), None
    )


def _pairs_images(path: Path) -> bool:
    with suppress(OSError), path.open("rb") as file:
        lines = file.read(HEAD_BYTES).decode(errors="replace").splitlines()
        words = next((line.replace(",", " ").split() for line in lines if line.strip()[:1].isdigit()), [])
        with suppress(SourceError):
            images = [within(path.parent, name, where=f"{path}") for name in words[1::2]]
            return len(words) == 4 and all(one.suffix.lower() in _IMAGES and one.is_file() for one in images)
    return False


def _read_associations(path: Path, notes: list[str]) -> tuple[ImageList, ImageList]:
    """Read lines of two stamps and files, depth first where its path says that it is."""
    colour, depth = [], []
    for where, words in table(path, "stamp", "rgb/filename", "stamp", "depth/filename"):
        first, second = words[:2], words[2:]
        if "depth" in first[1].lower() and "depth" not in second[1].lower():
            first, second = second, first
        colour.append((where, *first))
        depth.append((where, *second))
    images = (_images(path.parent, rows, notes, path=path) for rows in (colour, depth))
    return next(images), next(images)


def _images(folder: Path, rows: Sequence[tuple[str, ...]], notes: list[str], *, path: Path) -> ImageList:
    """Return the images of rows of place, stamp and filename that exist, in time order."""
    stamps_ns, paths = [], []
    for where, stamp, filename in rows:
        stamps_ns.append(parse_stamp(stamp, where=where))
        paths.append(within(folder, filename, where=where))
    name = path.name
    if (unpadded_ns := unpadded_stamps([stamp for _, stamp, _ in rows])) is not None:
        stamps_ns = unpadded_ns.tolist()
        notes.append(f"{name}: {UNPADDED_NOTE}")
    if not paths:
        raise SourceError(f"{path}: empty list; want lines of: stamp filename")
    exists = present(paths)
    kept = [i for i, found in enumerate(exists) if found]
    if not kept:
        raise SourceError(f"{path}: none of its {len(paths)} images exists; the first is {paths[0]}")
    if len(kept) < len(paths):
        notes.append(f"{name}: {len(paths) - len(kept)} of {len(paths)} listed images do not exist; dropped")
    images, order_notes = ImageList.in_time([stamps_ns[i] for i in kept], [paths[i] for i in kept], what=name)
    notes.extend(order_notes)
    return images


def _name_of(path: Path) -> str:
    """Return the recording that TUM's list names, ``# file: 'rgbd_…_xyz.bag'``, or else the folder."""
    for line in read_lines(path):
        if not line.startswith("#"):
            break
        if found := re.match(r"#\s*file:\s*'(.+)'", line):
            return found[1]
    return path.resolve().parent.name
