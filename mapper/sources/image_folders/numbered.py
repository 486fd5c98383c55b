"""Folders of numbered images: 7-Scenes (Shotton et al. 2013), Redwood (Choi et al. 2015) and the like.

7-Scenes keeps ``frame-000000.color.png``, ``.depth.png`` and ``.pose.txt`` together; Redwood keeps colour
(``rgb*``, ``color*``, ``image*``) and depth (``depth*``) in two folders and the poses in one ``.log``. Names
such as ``000001-000000033369.jpg`` carry a number and microseconds; others carry a number only, and stamps
follow from the frame rate. BundleFusion's are named as 7-Scenes', with info.txt; ScanNet's extracted folders
are as Redwood's, with a pose file a frame. Depth may be .npy, PFM or OpenEXR.
"""

import re
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from mapper.core.errors import SourceError
from mapper.core.geometry import Transform
from mapper.core.trajectory import Trajectory
from mapper.core.units import MM_PER_M
from mapper.runtime.regular_files import HEAD_BYTES
from mapper.sources.base import ImageFile, Log
from mapper.sources.calibration import PRIMESENSE, SEVEN_SCENES
from mapper.sources.calibration_file import calibration_files
from mapper.sources.config import SourceConfig
from mapper.sources.image_files import png
from mapper.sources.image_folders.pairing import ordered_pairs
from mapper.sources.image_folders.rgbd import FramePair, assumed_camera_note, find_calibration, rgbd_log
from mapper.sources.image_folders.tum import read_truth
from mapper.sources.listed_files import only_one
from mapper.sources.scan_stamps import (
    BY_NUMBERS,
    Wording,
    line_of_each,
    listed_stamps,
    stamp_at,
    stamps_list,
    unit_of_counts,
)
from mapper.sources.text import parse_count, parse_numbers, pose_from_matrix, rows, truth_from

RATE_HZ = 30.0
LOOKED_FOR = "frame-000000.color.png and .depth.png (7-Scenes), numbered images in rgb/ and depth/ (Redwood)"

_COLOUR_FOLDER = re.compile(r"rgb|colou?r|image", re.IGNORECASE)
_DEPTH_FOLDER = re.compile(r"(?:^|[^a-z])depth", re.IGNORECASE)
_DEPTH_ENDINGS = frozenset({".npy", ".pfm", ".exr"})
_IMAGE_ENDINGS = frozenset({".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".tif", ".tiff", ".bmp", ".webp"})
_NUMBERED = re.compile(r"\D*(?P<number>\d{1,18})(?:-(?P<microseconds>\d+))?\D*")
_POSES = ("groundtruth.txt", "poses.txt", "pose.txt")
_TRAJECTORIES = ("*traj*.log", "*traj*.txt", "*.log", *_POSES)
_SEVEN_SCENES = re.compile(r"frame-\d+\.color\.\w+")


@dataclass(frozen=True, slots=True)
class NumberedPair:
    """A colour and a depth image with the same number."""

    number: int
    colour: Path
    depth: ImageFile
    microseconds: int | None


@dataclass(frozen=True, slots=True)
class NumberedImages:
    """The pairs of a folder, by increasing number, and notes on images without a partner."""

    pairs: Sequence[NumberedPair]
    notes: Sequence[str]


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Images of one kind in a folder.

    Attributes:
        name: Name of the folder.
        numbered: Path and microseconds of the images whose names have one number, by that number.
        images: All images, whatever their names.
    """

    name: str
    numbered: Mapping[int, tuple[Path, int | None]]
    images: Sequence[Path]

    @property
    def total(self) -> int:
        """Number of images."""
        return len(self.images)


def recognise(path: Path) -> bool:
    """Return whether a path is a folder of numbered colour and depth images, or holds ``seq-*`` folders."""
    return find_images(path) is not None or bool(_sequences(path))


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a folder of numbered images, or of the only sequence in a folder.

    Raises:
        SourceError: The folder holds several sequences, or a pose file or the calibration is malformed.
    """
    opened = path
    if sequences := _sequences(path):
        path = only_one(path, sequences, "sequences")
    images = find_images(path)
    if images is None:
        raise SourceError(f"{path}: no colour and depth images with the same numbers; want {LOOKED_FOR}")
    is_seven_scenes = _SEVEN_SCENES.fullmatch(images.pairs[0].colour.name) is not None
    known = SEVEN_SCENES if is_seven_scenes else PRIMESENSE
    beside = next((folder for folder in (path, opened) if calibration_files(folder)[0]), path)
    calibration = find_calibration(beside, config.camera, known=known)
    notes = list(images.notes)
    if calibration.origin == known.origin:
        notes.append(assumed_camera_note(known))
    folders = [path, images.pairs[0].colour.parent]
    pairs, stamp_notes = stamped(images.pairs, rate_hz=config.rate_hz, beside=folders)
    ordered, order_notes = ordered_pairs(pairs, config, what="image names", path=path)
    return rgbd_log(
        ordered,
        calibration,
        depth_units_per_m=MM_PER_M,
        path=path,
        name=path.resolve().name,
        kind=_kind(path, is_seven_scenes=is_seven_scenes),
        truth=_read_truth(path, images.pairs, pairs),
        notes=[*notes, *stamp_notes, *order_notes],
    )


def _kind(folder: Path, *, is_seven_scenes: bool) -> str:
    if is_seven_scenes:
        return "bundlefusion" if (folder / "info.txt").is_file() else "7-scenes"
    return "scannet" if (folder / "intrinsic").is_dir() else "redwood"


def find_images(folder: Path) -> NumberedImages | None:
    """Return the numbered pairs of a folder, in two folders of it or side by side; None without any.

    Of several ways to pair images that with the most pairs is taken, and of equal ones that with the shortest
    names of folders.
    """
    if not folder.is_dir():
        return None
    colour_places, depth_places, beside = image_places(folder)
    colour, depth = max(
        [*product(colour_places, depth_places), beside], key=lambda places: len(_common(*places))
    )
    both = sorted(_common(colour, depth))
    if not both:
        return None
    notes = [
        f"{place.total - len(both)} {what} images have no partner of the same number; left out"
        for what, place in (("colour", colour), ("depth", depth))
        if place.total > len(both)
    ]
    total = max(place.total for place in (*colour_places, *depth_places, *beside))
    if 2 * len(both) < total:
        notes.append(
            f"only {len(both)} pairs are read of {total} images, less than half; "
            "names of colour and depth must have the same numbers"
        )
    for taken, places in ((colour, colour_places), (depth, depth_places)):
        others = [place.name for place in places if place is not taken and _common(place, taken)]
        if taken in places and others:
            notes.append(f"{taken.name}/ is read, not {', '.join(f'{name}/' for name in others)}")
    pairs = [
        NumberedPair(n, colour.numbered[n][0], depth.numbered[n][0], colour.numbered[n][1]) for n in both
    ]
    return NumberedImages(pairs, notes)


def image_places(folder: Path) -> tuple[Sequence[Place], Sequence[Place], tuple[Place, Place]]:
    """Return a folder's folders of colour and those of depth images, and both kinds side by side in it.

    Where none is called depth, those whose first image is a PNG of 16 bits are; where none is called colour,
    all others are.
    """
    inside = sorted((path for path in folder.iterdir() if path.is_dir()), key=lambda p: (len(p.name), p.name))
    are_depth = [_DEPTH_FOLDER.search(path.name) is not None for path in inside]
    if not any(are_depth):
        are_depth = [_begins_with_depth(path) for path in inside]
    others = [path for path, is_depth in zip(inside, are_depth, strict=True) if not is_depth]
    called = [path for path in others if _COLOUR_FOLDER.match(path.name)]
    colour_places = [_in_folder(path) for path in (called or others if any(are_depth) else called)]
    depth_places = [
        _in_folder(path, endings=_IMAGE_ENDINGS | _DEPTH_ENDINGS)
        for path, is_depth in zip(inside, are_depth, strict=True)
        if is_depth
    ]
    return colour_places, depth_places, (_in_folder(folder, r"colou?r|rgb"), _in_folder(folder, r"depth"))


def _begins_with_depth(folder: Path) -> bool:
    first = next((path for path in sorted(folder.glob("*.png")) if path.is_file()), None)
    with suppress(OSError):
        if first is not None:
            with first.open("rb") as file:
                return png.is_grey16(file.read(HEAD_BYTES))
    return False


def stamped(
    images: Sequence[NumberedPair],
    *,
    rate_hz: float | None,
    usual_hz: float = RATE_HZ,
    beside: Sequence[Path] = (),
) -> tuple[list[FramePair], list[str]]:
    """Return the pairs with stamps, and notes on what was assumed.

    Stamps are from their names, else from a list in the folders ``beside``, else from numbers that are times,
    else from their numbers at a rate, of which None is the usual. One that is given goes before the list.
    """
    notes: list[str] = []
    if all(pair.microseconds is not None for pair in images):
        stamps_ns = [1000 * (pair.microseconds or 0) for pair in images]
    elif rate_hz is None and (listed := _listed(images, beside, notes)):
        stamps_ns = listed
    elif unit := unit_of_counts([pair.number for pair in images]):
        stamps_ns = [pair.number * unit.ns for pair in images]
        notes.append(f"numbers in file names are taken for {unit.name}: they advance by {unit.step}")
    else:
        stamps_ns = [stamp_at(pair.number, rate_hz=rate_hz or usual_hz) for pair in images]
        if rate_hz is None:
            notes.append(f"file names carry no time; {usual_hz:g} frames a second assumed (source.rate_hz)")
    pairs = [
        FramePair(stamp_ns, pair.colour, stamp_ns, pair.depth)
        for stamp_ns, pair in zip(stamps_ns, images, strict=True)
    ]
    return pairs, notes


def _listed(images: Sequence[NumberedPair], folders: Sequence[Path], notes: list[str]) -> list[int]:
    """Return stamps of a list, none without one that fits; add notes on it."""
    path = stamps_list(folders)
    if path is None:
        return []
    try:
        stamps_ns, more = listed_stamps(path, [pair.colour for pair in images], Wording("pairs of images"))
    except SourceError as error:
        notes.append(f"{path.name} is not used: {error}")
        return []
    notes += [f"stamps are those of {path.name}", *more]
    return list(map(int, stamps_ns))


def _sequences(path: Path) -> list[Path]:
    return sorted(folder for folder in path.glob("seq-*") if find_images(folder) is not None)


def _in_folder(folder: Path, word: str = "", *, endings: Set[str] = _IMAGE_ENDINGS) -> Place:
    """Return the images of a folder whose names contain the word."""
    images = [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in endings
        and path.name[0] != "."
        and re.search(word, path.stem, re.IGNORECASE)
    ]
    numbered: dict[int, tuple[Path, int | None]] = {}
    for path in images:
        if name := _NUMBERED.fullmatch(path.stem):
            microseconds = name["microseconds"]
            numbered[int(name["number"])] = (path, None if microseconds is None else int(microseconds))
    return Place(folder.name, numbered, images)


def _common(colour: Place, depth: Place) -> Set[int]:
    return colour.numbered.keys() & depth.numbered.keys()


def _read_truth(
    folder: Path, images: Sequence[NumberedPair], pairs: Sequence[FramePair]
) -> tuple[Trajectory | None, list[str]]:
    """Read one pose file a frame if there are any, else a trajectory: Redwood's, TUM's, or matrices."""
    poses: list[tuple[int, Transform | None]] = []
    for image, pair in zip(images, pairs, strict=True):
        beside = image.colour.with_name(f"{image.colour.stem.split('.')[0]}.pose.txt")
        places = [beside, *(folder / name / f"{image.colour.stem}.txt" for name in ("pose", "poses"))]
        path = next(filter(Path.is_file, places), None)
        if path is not None:
            matrix = [_row_of_4(path, number, words) for number, words in rows(path)]
            poses.append((pair.stamp_ns, _pose_of(matrix, path)))
    if poses:
        return truth_from(poses, what="pose files")
    path = next((one for name in _TRAJECTORIES for one in sorted(folder.glob(name))), None)
    if path is None:
        return None, []
    columns = len(next(rows(path), (0, []))[1])
    if columns in (12, 16):
        return _read_matrices(path, images, pairs)
    if columns == 8:
        return read_truth(path)
    if path.name in _POSES:
        return None, [f"{path.name} is not used: {columns} columns, want 8 of TUM's, or 12 or 16 of a matrix"]
    return _read_redwood(path, pairs)


def _read_matrices(
    path: Path, images: Sequence[NumberedPair], pairs: Sequence[FramePair]
) -> tuple[Trajectory | None, list[str]]:
    """Read a 3×4 or 4×4 matrix a line: of each image, or of the number of each, counted from 0."""
    lines = [parse_numbers(words, where=f"{path}:{number}") for number, words in rows(path)]
    at = line_of_each([image.colour for image in images], len(lines))
    if at is None or at.max() >= len(lines):
        return None, [f"{path.name} is not used: {len(lines)} poses for {len(pairs)} pairs of images"]
    poses = [pose_from_matrix(lines[k].reshape(-1, 4)) if len(lines[k]) in (12, 16) else None for k in at]
    truth, notes = truth_from(
        [(pair.stamp_ns, pose) for pair, pose in zip(pairs, poses, strict=True)], what=path.name
    )
    if at.max() < len(lines) - 1:
        notes = [*notes, f"{path.name}: {len(lines)} poses for {len(pairs)} pairs of images, {BY_NUMBERS}"]
    return truth, notes


def _read_redwood(path: Path, pairs: Sequence[FramePair]) -> tuple[Trajectory | None, list[str]]:
    """Read blocks of a line ``i i i+1`` and a 4×4 matrix; i counts the images from 0."""
    lines = list(rows(path))
    if len(lines) % 5:
        raise SourceError(f"{path}: {len(lines)} lines, want blocks of 5: i i i+1 and a 4×4 matrix")
    poses: list[tuple[int, Transform | None]] = []
    for block in range(0, len(lines), 5):
        number, words = lines[block]
        if len(words) != 3:
            raise SourceError(f"{path}:{number}: {' '.join(words)!r}, want the block's number, as in: 0 0 1")
        index = parse_count(words[0], where=f"{path}:{number}")
        if index >= len(pairs):
            raise SourceError(
                f"{path}:{number}: pose of image {index}, but there are only {len(pairs)} images"
            )
        matrix = [_row_of_4(path, row_number, row) for row_number, row in lines[block + 1 : block + 5]]
        poses.append((pairs[index].stamp_ns, _pose_of(matrix, path)))
    return truth_from(poses, what=path.name)


def _row_of_4(path: Path, number: int, words: list[str]) -> list[float]:
    if len(words) != 4:
        raise SourceError(f"{path}:{number}: {len(words)} columns, want 4: a row of a 4×4 pose")
    return [float(value) for value in parse_numbers(words, where=f"{path}:{number}")]


def _pose_of(matrix: list[list[float]], path: Path) -> Transform | None:
    """Return camera-to-world with a rotation made exact; None where the file says the camera was lost."""
    if len(matrix) != 4:
        raise SourceError(f"{path}: {len(matrix)} rows, want a 4×4 camera-to-world pose")
    return pose_from_matrix(matrix)
