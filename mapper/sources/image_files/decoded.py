"""Images that are no files of their own, of messages, videos and packed files, and their encoding as PNG."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import DepthImage, Image

SATURATED = np.iinfo(np.uint16).max
"""The largest 16-bit depth is a sensor's way to say "nothing" (7-Scenes) or "too far": no measurement."""


def _no_file() -> None:
    return None


@dataclass(frozen=True, slots=True)
class DecodedColour:
    """Colour image that its source decodes; see :class:`mapper.sources.base.ImageFile`.

    Attributes:
        where: Name of the image in an error; its text is made when it is needed.
        decode: Returns the (H, W, 3) RGB image, or where its argument is false a grey one if that is faster.
        file: Returns the image as the file that it is stored as; None where it is no file.
        suffix: Ending of the file's name.
    """

    where: object
    decode: Callable[[bool], Image]
    file: Callable[[], bytes | None] = _no_file
    suffix: str = ".png"

    def __str__(self) -> str:
        return f"{self.where}"

    def read_bytes(self) -> bytes:
        """Return the image as a file, encoded as PNG if it is none yet."""
        return self.file() or encode_colour(self.decode(True))


@dataclass(frozen=True, slots=True)
class DecodedDepth:
    """Depth image that its source decodes; see :class:`mapper.sources.base.ImageFile`.

    Attributes:
        where: As of :class:`DecodedColour`.
        decode: Returns (H, W) depth in metres, 0 where nothing was measured.
        units_per_m: Units per metre of the file.
        file: Returns the image as the 16-bit file that it is stored as; None where it is no such file.
    """

    where: object
    decode: Callable[[], DepthImage]
    units_per_m: float
    file: Callable[[], bytes | None] = _no_file
    suffix: str = ".png"

    def __str__(self) -> str:
        return f"{self.where}"

    def read_bytes(self) -> bytes:
        """Return the image as a file, encoded as a PNG of 16 bits if it is none yet."""
        return self.file() or encode_depth(self.decode(), self.units_per_m)


@dataclass(frozen=True, slots=True)
class FilePart:
    """Bytes of a file that are an image; see :class:`mapper.sources.base.ImageFile`."""

    path: Path
    offset: int
    size: int
    suffix: str

    def __str__(self) -> str:
        return f"{self.path}, byte {self.offset}"

    def read_bytes(self) -> bytes:
        """Return them.

        Raises:
            OSError: The file cannot be read.
        """
        with self.path.open("rb") as file:
            file.seek(self.offset)
            return file.read(self.size)


def encode_colour(image: Image) -> bytes:
    """Return an (H, W, 3) RGB or (H, W) grey image as a PNG file."""
    return _png(image if image.ndim == 2 else np.ascontiguousarray(image[:, :, ::-1]))


def encode_depth(depth_m: DepthImage, units_per_m: float) -> bytes:
    """Return (H, W) depth as a PNG file of 16-bit units; what is too far for these is no measurement."""
    units = np.rint(depth_m * units_per_m)
    return _png(np.where(units < SATURATED, units, 0).astype(np.uint16))


def _png(pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    _, encoded = cv2.imencode(".png", pixels)
    return encoded.tobytes()
