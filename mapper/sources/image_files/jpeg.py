"""JPEG decoding that refuses damaged files.

OpenCV decodes whatever it can make of a file and prints libjpeg's warnings to stderr, out of any program's
reach. libjpeg-turbo's own interface reports them; its pixels are the same, and it takes less time. A JPEG has
no checksum, so damage that leaves valid codes passes.
"""

import simplejpeg

from mapper.core.errors import DataError
from mapper.core.frames import Image

START = b"\xff\xd8\xff"

_END = b"\xff\xd9"
_SCAN = b"\xff\xda"
_MOST_SCANS = 500
"""Scans that a progressive file may have, as libjpeg-turbo's own programs limit them: usual are ten, and each
costs as much time as a whole image, be it of a few bytes."""


def size_of(data: bytes) -> tuple[int, int]:
    """Return the width and height of a JPEG file, pixels, by its header.

    Raises:
        DataError: The header is damaged.
    """
    try:
        height_px, width_px, _, _ = simplejpeg.decode_jpeg_header(data)
    except ValueError as error:
        raise _damage(data, error) from None
    return width_px, height_px


def decode(data: bytes, *, colour: bool) -> Image:
    """Return the (H, W, 3) RGB or (H, W) grey pixels of a JPEG file.

    Raises:
        DataError: The file is cut short or damaged, as far as the decoder notices.
    """
    scans = data.count(_SCAN)
    if scans > _MOST_SCANS:
        raise DataError(f"damaged JPEG: {scans} scans, want {_MOST_SCANS} at most")
    try:
        pixels: Image = simplejpeg.decode_jpeg(data, "RGB" if colour else "GRAY")
    except ValueError as error:
        raise _damage(data, error) from None
    return pixels if colour else pixels[:, :, 0]


def _damage(data: bytes, error: ValueError) -> DataError:
    if _END not in data:
        return DataError("truncated JPEG: it ends before its end marker")
    return DataError(f"damaged JPEG: {error}")
