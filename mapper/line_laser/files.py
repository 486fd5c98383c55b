"""Folders of a line-laser sensor: its images, and the shots it is calibrated by."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.frames import Image
from mapper.core.timebase import Stamps
from mapper.line_laser.calibration import CalibrationShot, find_board
from mapper.line_laser.config import StripeConfig
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.image_files.reading import read_colour
from mapper.sources.scan_stamps import Wording, in_order, scan_stamps
from mapper.sources.text import parse_numbers, rows, time_order

SHOTS = "shots.csv"
_TIMES = "times.txt"
_IMAGES = Wording("images", rate="--set rate_hz", stamps_file="--times")
_ENDINGS = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".tif", ".tiff"})


def find_images(
    folder: Path, *, times: Path | None = None, rate_hz: float | None = None
) -> tuple[list[Path], Stamps, list[str]]:
    """Return a folder's images in time order, their stamps, and notes on what was assumed.

    Args:
        folder: Folder of images; stamps are in their names, or in ``times.txt`` in it or beside it.
        times: List of stamps that goes before both.
        rate_hz: Images a second without any stamps; None is 10.

    Raises:
        SourceError: There is no such folder, or no image in it, or the list does not fit.
    """
    if not folder.is_dir():
        raise SourceError(f"{folder}: no such folder; want a folder of images")
    images = in_order(path for path in folder.iterdir() if path.suffix.lower() in _ENDINGS)
    if not images:
        inside = "; those in images/?" if (folder / "images").is_dir() else ""
        raise SourceError(f"{folder}: no images; want files ending in {' '.join(sorted(_ENDINGS))}{inside}")
    lists = (folder / _TIMES, folder.parent / _TIMES)
    times_file = next((path for path in lists if path.is_file()), None)
    stamps_ns, notes = scan_stamps(images, chosen=times, beside=times_file, rate_hz=rate_hz, wording=_IMAGES)
    order, more = time_order(stamps_ns, what="images")
    return [images[i] for i in order], stamps_ns[order], [*notes, *more]


def read_shots(
    path: Path, config: StripeConfig, *, progress: Progress = SILENT
) -> tuple[list[CalibrationShot], tuple[int, int], list[str]]:
    """Return what the shots of a calibration show, the images' width and height, and notes on what does not.

    Args:
        path: Lines ``image,range_m[,width_m]``, or the folder with such a ``shots.csv``: images of a board
            that faces the sensor, in the middle of the image, and how far and how wide it is.
        config: Settings of the stripe detection.
        progress: Receives the count of images.

    Raises:
        SourceError: A file is missing or malformed, or the images differ in size.
    """
    path = path / SHOTS if path.is_dir() else path
    lines = [(number, words) for number, words in rows(path, separator=",") if words[0] != "image"]
    shots: list[CalibrationShot] = []
    notes: list[str] = []
    size_px = (0, 0)
    with progress.stage("shots") as report:
        for done, (number, words) in enumerate(lines, start=1):
            where = f"{path}:{number}"
            image = read_colour(path.parent / words[0])
            if size_px not in ((0, 0), image.shape[1::-1]):
                raise SourceError(
                    f"{where}: image of {image.shape[1]}×{image.shape[0]} px, "
                    f"but those above are {size_px[0]}×{size_px[1]}"
                )
            size_px = (image.shape[1], image.shape[0])
            shot, note = _seen(image, words, config, where)
            shots.extend(shot)
            notes.extend(note)
            report(done, len(lines))
    return shots, size_px, notes


def _seen(
    image: Image, words: Sequence[str], config: StripeConfig, where: str
) -> tuple[list[CalibrationShot], list[str]]:
    """Return one shot, or none, and a note on what it does not show."""
    if len(words) not in (2, 3):
        raise SourceError(f"{where}: {len(words)} columns, want image,range_m or image,range_m,width_m")
    numbers = parse_numbers([word for word in words[1:] if word], where=where)
    if not len(numbers) or not (np.isfinite(numbers) & (numbers > 0.0)).all():
        raise SourceError(f"{where}: want a range and a width in metres, both > 0")
    seen = find_board(image, config)
    if seen is None:
        return [], [f"{where}: {words[0]} shows no level stripe in its middle; left out"]
    range_m, *width_m = (float(number) for number in numbers)
    if width_m and seen.width_px is None:
        return [CalibrationShot(seen, range_m)], [f"{where}: the board leaves {words[0]}; width not used"]
    return [CalibrationShot(seen, range_m, *width_m)], []
