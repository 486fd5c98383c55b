"""Kintinuous' and ElasticFusion's .klg files: a count, then stamp, depth and image of each frame.

Depth is 16-bit millimetres, raw or packed by zlib, the image RGB or a JPEG of the same size; the camera is
not stored. https://github.com/mp3guy/Logger2
"""

from collections.abc import Iterator
from functools import partial
from math import isqrt
from pathlib import Path

import cv2
import numpy as np

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import Image
from mapper.core.timebase import LATEST_NS
from mapper.core.units import MM_PER_M
from mapper.sources.config import SourceConfig
from mapper.sources.image_files import jpeg
from mapper.sources.image_files.decoded import DecodedColour, DecodedDepth, FilePart
from mapper.sources.image_files.reading import read_grey
from mapper.sources.image_folders.posed import PosedFrames, camera_of
from mapper.sources.image_folders.rgbd import FramePair, first_size
from mapper.sources.image_folders.scannet_sens import depth_m_of_part

FILES = (".klg",)
_COUNT = np.dtype("<i4")
_FRAME = np.dtype([("stamp_us", "<i8"), ("depth_bytes", "<i4"), ("image_bytes", "<i4")])


def read_frames(path: Path, config: SourceConfig) -> PosedFrames:
    """Return the frames of a file, without poses.

    Raises:
        SourceError: The file cannot be read or has no frame, or nothing states the camera.
    """
    try:
        count = int(np.fromfile(path, _COUNT, 1).sum())
        frames = list(_frames(path))
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from None
    if not frames:
        raise SourceError(f"{path}: no frame in it, or no .klg file")
    _, first_depth, first = frames[0]
    with first.path.open("rb") as file:
        file.seek(first.offset)
        is_jpeg = file.read(len(jpeg.START)) == jpeg.START
    width_px = isqrt(first.size * 4 // 9)  # of 4:3, as its depth cameras have
    size_px = (
        first_size([image for *_, image in frames], read_grey, where=f"{path}")
        if is_jpeg
        else (width_px, width_px * 3 // 4)
    )
    camera = camera_of(path, config, None)
    units_per_m = camera.depth_units_per_m or MM_PER_M
    is_packed = first_depth.size != 2 * size_px[0] * size_px[1]
    pairs = []
    for stamp_ns, depth, image in frames:
        decode = partial(depth_m_of_part, depth, size_px, is_packed, units_per_m)
        colour = image if is_jpeg else DecodedColour(image, partial(_raw_image, image, size_px))
        pairs.append(FramePair(stamp_ns, colour, stamp_ns, DecodedDepth(depth, decode, units_per_m)))
    notes = [] if count == len(pairs) else [f"{path.name}: {len(pairs)} whole frames; it says {count}"]
    return PosedFrames(pairs, [None] * len(pairs), camera, units_per_m, notes)


def _frames(path: Path) -> Iterator[tuple[int, FilePart, FilePart]]:
    """Yield stamp, depth and image of every whole frame."""
    size, at = path.stat().st_size, _COUNT.itemsize
    with path.open("rb") as file:
        while at + _FRAME.itemsize <= size:
            file.seek(at)
            stamp_us, depth_bytes, image_bytes = np.frombuffer(file.read(_FRAME.itemsize), _FRAME)[0].tolist()
            at += _FRAME.itemsize
            end = at + depth_bytes + image_bytes
            if min(depth_bytes, image_bytes) <= 0 or end > size or not 0 <= stamp_us <= LATEST_NS // 1000:
                return
            yield (
                1000 * stamp_us,
                FilePart(path, at, depth_bytes, ".png"),
                FilePart(path, at + depth_bytes, image_bytes, ".jpg"),
            )
            at = end


def _raw_image(part: FilePart, size_px: tuple[int, int], in_colour: bool) -> Image:
    try:
        pixels = np.frombuffer(part.read_bytes(), np.uint8).reshape(size_px[1], size_px[0], 3)
        return pixels if in_colour else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)
    except (OSError, ValueError) as error:
        raise FrameError(f"{part}: no image of {size_px[0]}×{size_px[1]} px: {error}") from None
