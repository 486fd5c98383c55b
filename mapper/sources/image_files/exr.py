"""OpenEXR images of depth, decoded by the library openexr."""

import re
import struct
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, FrameError
from mapper.runtime.extras import require

START = b"v/1\x01"
_WINDOW = re.compile(rb"dataWindow\0box2i\0\x10\0\0\0(.{16})", re.DOTALL)
_OF_DEPTH = ("Z", "DEPTH", "D", "V", "Y", "R")
"""Names of channels, the part after the last dot, in capitals: the first that is there has the depth."""


def require_decoder() -> None:
    """Refuse a log whose depth is OpenEXR where the library is not installed.

    Raises:
        DependencyError: It is not.
    """
    require("OpenEXR", "exr", "reading depth as OpenEXR")


def size_of(data: bytes) -> tuple[int, int]:
    """Return the width and height that an image's header states.

    Raises:
        DataError: It states none.
    """
    found = _WINDOW.search(data)
    if found is None:
        raise DataError(f"an OpenEXR file of {len(data)} bytes without a window of data")
    left, top, right, bottom = struct.unpack("<4i", found[1])
    return right - left + 1, bottom - top + 1


def decode(data: bytes, where: str) -> NDArray[np.float32]:
    """Return the (H, W) floats of the channel of depth; ``where`` is what an error names.

    Raises:
        DataError: Its header states no size.
        FrameError: The file is damaged, or has no such channel.
    """
    import Imath
    import OpenEXR

    width_px, height_px = size_of(data)
    try:
        file = OpenEXR.InputFile(BytesIO(data))  # OpenEXR.File returns damaged images, and prints
        names = list(file.header()["channels"])
        of_depth = {name.rpartition(".")[2].upper(): name for name in names}
        found = next((of_depth[name] for name in _OF_DEPTH if name in of_depth), None)
        if found is None:
            raise FrameError(
                f"{where}: channels {', '.join(names)}; want depth in one of {' '.join(_OF_DEPTH)}"
            )
        values = file.channel(found, Imath.PixelType(Imath.PixelType.FLOAT))
        return np.frombuffer(values, np.float32).reshape(height_px, width_px)
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        raise FrameError(f"{where}: not a sound OpenEXR file: {error}") from None
