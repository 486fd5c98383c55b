"""Images whose names are their stamps, in a folder of colour and one of depth, or side by side.

Names are decimal seconds, or whole s, ms, µs or ns since the epoch, with words before or after; depth is in
millimetres unless a calibration says otherwise.
"""

import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.timebase import Stamps
from mapper.core.units import MM_PER_M
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.reading import TUM_UNITS_PER_M
from mapper.sources.image_folders.numbered import image_places
from mapper.sources.image_folders.pairing import ImageList
from mapper.sources.image_folders.tum import log_of_images
from mapper.sources.scan_stamps import stamps_in

_AFTER = re.compile(r"\D+$")


def recognise(path: Path) -> bool:
    """Return whether a path is a folder with two or more colour and depth images named by their stamps."""
    return path.is_dir() and not any(path.glob("*.mbag")) and _images(path) is not None


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a folder of stamped images: each colour image with its nearest depth image.

    Raises:
        SourceError: No two images pair, a line of the truth is malformed, or the camera is unknown.
    """
    images = _images(path)
    if images is None:
        raise SourceError(f"{path}: no colour and depth images named by their stamps")
    is_tums = (path / "depth.txt").is_file()  # a folder of TUM's that lost its other list
    units_per_m = TUM_UNITS_PER_M if is_tums else MM_PER_M
    name = path.resolve().name
    return log_of_images(path, *images, config, depth_units_per_m=units_per_m, name=name, notes=[])


def _images(folder: Path) -> tuple[ImageList, ImageList] | None:
    """Return colour and depth images by the stamps in their names; None without two or more of each."""
    colours, depths, beside = image_places(folder)
    places = [*product(colours, depths), beside]
    most = max(places, key=lambda pair: min(len(place.images) for place in pair))
    colour, depth = (_by_stamp(place.images) for place in most)
    return None if colour is None or depth is None else (colour, depth)


def _by_stamp(images: Sequence[Path]) -> ImageList | None:
    stamps_ns: Stamps | None = stamps_in([_AFTER.sub("", path.stem) for path in images])
    if stamps_ns is None or len(np.unique(stamps_ns)) < 2:
        return None
    order = np.argsort(stamps_ns, kind="stable")
    return ImageList(stamps_ns[order], [images[i] for i in order])
