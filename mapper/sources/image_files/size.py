"""Sizes of images by the headers of their files, so that none is decoded that would fill the memory."""

import re
import struct

from mapper.core.errors import DataError
from mapper.sources.image_files import exr, jpeg, png

MOST_MEGAPIXELS = 100
"""Size of the largest image that is decoded: depth cameras have a megapixel, industrial cameras up to fifty,
and a file of a few megabytes can announce, and hold, thousands."""

_BMP_SIZE = struct.Struct("<18xii")  # width, and height, which is negative where rows run downwards
_PNM_HEADER = re.compile(rb"P[1-6f](?:\s+|#[^\n]*\n)+(\d{1,9})(?:\s+|#[^\n]*\n)+(\d{1,9})\s")
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_SHORT = 256, 257, 3  # tags, and the type of a 16-bit value


def check_pixels(data: bytes) -> None:
    """Refuse an image file that would be decoded to too many pixels, and any of another format.

    Raises:
        DataError: It is larger than ``MOST_MEGAPIXELS``, or no PNG, JPEG, BMP, TIFF, WebP or PBM, PGM or PPM.
    """
    width_px, height_px = size_of(data)
    if width_px * height_px > MOST_MEGAPIXELS * 10**6:
        raise DataError(
            f"an image of {width_px}×{height_px} px; more than {MOST_MEGAPIXELS} megapixels are not decoded"
        )


def size_of(data: bytes) -> tuple[int, int]:
    """Return the width and height that an image's header states."""
    try:
        if data.startswith(png.SIGNATURE):
            return png.size_of(data)
        if data.startswith(jpeg.START):
            return jpeg.size_of(data)
        if data.startswith(exr.START):
            return exr.size_of(data)
        if data.startswith(b"BM"):
            width_px, height_px = _BMP_SIZE.unpack_from(data)
            return abs(width_px), abs(height_px)
        if data.startswith((b"II*\0", b"MM\0*")):
            return _tiff_size(data)
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return 1, 1  # the format has 14 bits for each side
        if header := _PNM_HEADER.match(data):
            return int(header[1]), int(header[2])
    except struct.error:
        raise DataError(f"an image file of {len(data)} bytes that ends within its header") from None
    raise DataError(
        f"not an image of a known format ({len(data)} bytes): PNG, JPEG, BMP, TIFF, WebP, PGM or PPM"
    )


def _tiff_size(data: bytes) -> tuple[int, int]:
    """Return the largest sides that any of the first directory's tags announce."""
    order = "<" if data.startswith(b"II") else ">"
    (start,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, start)
    sides = {_TIFF_WIDTH: 0, _TIFF_HEIGHT: 0}
    for at in range(start + 2, start + 2 + 12 * count, 12):
        tag, kind = struct.unpack_from(f"{order}HH", data, at)
        if tag in sides:
            (value,) = struct.unpack_from(order + ("H" if kind == _TIFF_SHORT else "I"), data, at + 8)
            sides[tag] = max(sides[tag], value)
    return sides[_TIFF_WIDTH], sides[_TIFF_HEIGHT]
