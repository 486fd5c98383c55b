"""ICL-NUIM folders: associations.txt, rgb/N.png, depth/N.png and *.gt.freiburg (Handa et al. 2014).

Lines of ``associations.txt`` are ``N depth/N.png N rgb/N.png``, of the truth ``N tx ty tz qx qy qz qw``;
N counts the frames, 30 a second. The published camera has fy = -480 px: rows of the images run down as usual,
but the y axes of camera and world point up, so that both frames are left-handed.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mapper.core.errors import SourceError
from mapper.core.geometry import Transform
from mapper.core.trajectory import Trajectory
from mapper.sources.base import Log
from mapper.sources.calibration import ICL_NUIM
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.reading import TUM_UNITS_PER_M, has_floats
from mapper.sources.image_folders.numbered import RATE_HZ, find_images
from mapper.sources.image_folders.pairing import ordered_pairs, usable_pairs
from mapper.sources.image_folders.rgbd import FramePair, assumed_camera_note, find_calibration, rgbd_log
from mapper.sources.image_folders.tum import METRES_NOTE, UNITS_NOTE
from mapper.sources.listed_files import within
from mapper.sources.scan_stamps import stamp_at
from mapper.sources.text import (
    parse_count,
    parse_numbers,
    pose_from_numbers,
    rows,
    table,
    truth_from,
)

LOOKED_FOR = "associations.txt of N depth/N.png N rgb/N.png (ICL-NUIM)"

_LIST = "associations.txt"
_COLUMNS = ("number", "depth/number.png", "number", "rgb/number.png")
_TRUTHS = ("*.gt.freiburg", "groundtruth.txt")
_NUMBER = re.compile(r"\d{1,6}")  # a stamp of the epoch has more digits


def recognise(path: Path) -> bool:
    """Return whether a path is a folder with associations by frame number, or with ICL-NUIM's truth."""
    return _lists_numbers(path / _LIST) or (_has_truth(path) and find_images(path) is not None)


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of an ICL-NUIM folder.

    Raises:
        SourceError: A file is malformed, an image lies outside of the folder, none exists, or they are of
            another size than the data set's and there is no calibration.
    """
    rate_hz = config.rate_hz or RATE_HZ
    pairs, notes = _read_pairs(path, config, rate_hz)
    calibration = find_calibration(path, config.camera, known=ICL_NUIM)
    is_own = not _has_truth(path)
    if is_own and calibration.origin == ICL_NUIM.origin:
        notes.append(assumed_camera_note(ICL_NUIM))
    if is_own and config.rate_hz is None:
        notes.append(f"frames carry a number, no time; {rate_hz:g} a second assumed (source.rate_hz)")
    are_units_assumed = is_own and calibration.depth_units_per_m is None
    if are_units_assumed:
        notes.append(METRES_NOTE if has_floats(pairs[0].depth) else UNITS_NOTE)
    log = rgbd_log(
        pairs,
        calibration,
        depth_units_per_m=TUM_UNITS_PER_M,
        path=path,
        name=path.resolve().name,
        kind="icl-nuim",
        truth=_read_truth(path, rate_hz),
        notes=notes,
    )
    return replace(log, are_units_assumed=are_units_assumed)


def _has_truth(folder: Path) -> bool:
    return any(folder.glob(_TRUTHS[0]))


def _lists_numbers(path: Path) -> bool:
    """Return whether the first line of a list, which need not exist, pairs images named by its numbers."""
    if not path.is_file():
        return False
    words = next((words for _, words in rows(path)), [])
    return len(words) == 4 and all(
        _NUMBER.fullmatch(number) is not None and Path(image).stem == number
        for number, image in (words[:2], words[2:])
    )


def _read_pairs(folder: Path, config: SourceConfig, rate_hz: float) -> tuple[Sequence[FramePair], list[str]]:
    """Return the pairs of the list, or without one those of images with the same number."""
    if (folder / _LIST).is_file():
        return usable_pairs(_read_list(folder / _LIST, rate_hz), config, listed_in=folder / _LIST)
    images = find_images(folder)
    if images is None:
        raise SourceError(f"{folder}: no colour and depth images with the same numbers; want {LOOKED_FOR}")
    stamped = [(stamp_at(pair.number, rate_hz=rate_hz), pair) for pair in images.pairs]
    pairs = [FramePair(stamp_ns, pair.colour, stamp_ns, pair.depth) for stamp_ns, pair in stamped]
    ordered, order_notes = ordered_pairs(pairs, config, what="image names", path=folder)
    return ordered, [*images.notes, *order_notes]


def _read_list(path: Path, rate_hz: float) -> list[FramePair]:
    pairs = []
    for where, words in table(path, *_COLUMNS):
        sides = sorted((words[:2], words[2:]), key=lambda side: "depth" in side[1])
        (stamp_ns, colour), (depth_stamp_ns, depth) = (
            (
                stamp_at(parse_count(number, where=where), rate_hz=rate_hz),
                within(path.parent, name, where=where),
            )
            for number, name in sides
        )
        pairs.append(FramePair(stamp_ns, colour, depth_stamp_ns, depth))
    if not pairs:
        raise SourceError(f"{path}: empty list; want lines of {' '.join(_COLUMNS)}")
    return pairs


def _read_truth(folder: Path, rate_hz: float) -> tuple[Trajectory | None, list[str]]:
    """Return the poses of the file of truth, by frame number, left-handed as published."""
    path = next((path for name in _TRUTHS for path in sorted(folder.glob(name))), None)
    if path is None:
        return None, []
    poses: list[tuple[int, Transform | None]] = []
    for where, words in table(path, "number", "tx", "ty", "tz", "qx", "qy", "qz", "qw"):
        number, pose = parse_count(words[0], where=where), parse_numbers(words[1:], where=where)
        poses.append((stamp_at(number, rate_hz=rate_hz), pose_from_numbers(pose)))
    return truth_from(poses, what=path.name)
