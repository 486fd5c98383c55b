"""Image messages as arrays: RGB, grey, and depth in metres."""

import math
import struct
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError
from mapper.core.frames import DepthImage, Image
from mapper.core.units import MM_PER_M
from mapper.sources.image_files import png
from mapper.sources.image_files.decoded import SATURATED
from mapper.sources.image_files.reading import (
    are_swapped,
    decode_colour,
    decode_depth,
    decode_grey,
    depth_m_from,
    valid_depth,
)
from mapper.sources.image_files.rvl import decode_rvl
from mapper.sources.ros.messages import FileMessage, ImageMessage, PixelsMessage


@dataclass(frozen=True, slots=True)
class _Encoding:
    """Storage of colour pixels, and OpenCV's conversions to RGB and to grey; None for no conversion.

    Of values of 16 bits the upper 8 are used. ``rows``, with planes of colour, are of each row of the image.
    """

    channels: int
    to_rgb: int | None
    to_grey: int | None
    kind: str = "u1"
    rows: Fraction = Fraction(1)


_COLOUR_8 = {
    "rgb8": _Encoding(3, None, cv2.COLOR_RGB2GRAY),
    "bgr8": _Encoding(3, cv2.COLOR_BGR2RGB, cv2.COLOR_BGR2GRAY),
    "8UC3": _Encoding(3, cv2.COLOR_BGR2RGB, cv2.COLOR_BGR2GRAY),
    "rgba8": _Encoding(4, cv2.COLOR_RGBA2RGB, cv2.COLOR_RGBA2GRAY),
    "bgra8": _Encoding(4, cv2.COLOR_BGRA2RGB, cv2.COLOR_BGRA2GRAY),
    "8UC4": _Encoding(4, cv2.COLOR_BGRA2RGB, cv2.COLOR_BGRA2GRAY),
    "mono8": _Encoding(1, None, None),
    "8UC1": _Encoding(1, None, None),
    **dict.fromkeys(("yuv422", "uyvy"), _Encoding(2, cv2.COLOR_YUV2RGB_UYVY, cv2.COLOR_YUV2GRAY_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), _Encoding(2, cv2.COLOR_YUV2RGB_YUY2, cv2.COLOR_YUV2GRAY_YUY2)),
    # ROS names a Bayer pattern by its first two pixels, OpenCV by those of the second row and column.
    "bayer_rggb8": _Encoding(1, cv2.COLOR_BayerBG2RGB, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": _Encoding(1, cv2.COLOR_BayerRG2RGB, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": _Encoding(1, cv2.COLOR_BayerGR2RGB, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": _Encoding(1, cv2.COLOR_BayerGB2RGB, cv2.COLOR_BayerGB2GRAY),
    "nv12": _Encoding(1, cv2.COLOR_YUV2RGB_NV12, cv2.COLOR_YUV2GRAY_420, rows=Fraction(3, 2)),
    "nv21": _Encoding(1, cv2.COLOR_YUV2RGB_NV21, cv2.COLOR_YUV2GRAY_420, rows=Fraction(3, 2)),
}
_COLOUR = _COLOUR_8 | {
    name.replace("8", "16"): replace(encoding, kind="u2")
    for name, encoding in _COLOUR_8.items()
    if "8" in name and name not in ("mono8", "8UC1")  # those of 16 bits are depth
}
_COLOUR_ALIASES = {
    **{name.removesuffix("8"): name for name in ("rgb8", "bgr8", "rgba8", "bgra8")},
    "rgb24": "rgb8",
    "bgr24": "bgr8",
    "rgb888": "rgb8",
    "bgr888": "bgr8",
    "yuy2": "yuyv",
    **dict.fromkeys(("gray", "grey", "gray8", "grey8", "y8", "mono"), "mono8"),
}
"""Names of other libraries."""
_DEPTH = {
    "16UC1": "u2",
    "mono16": "u2",
    "16SC1": "i2",
    "32FC1": "f4",
    "64FC1": "f8",
    "32SC1": "i4",
    "Z16": "u2",
}
_DEPTH_KINDS = {name.lower(): kind for name, kind in _DEPTH.items()}
_TIFF_STARTS = (b"II*\x00", b"MM\x00*")
_IMAGE_STARTS = (b"\xff\xd8", b"\x89PNG", b"BM", *_TIFF_STARTS, b"RIFF", b"P")
DEPTH_HEADER = struct.Struct("<iff")  # compressedDepth's: how it is stored, and two parameters of that


def is_depth(message: ImageMessage) -> bool:
    """Return whether an image is of depth: by its bytes, else by what its encoding or format says."""
    if isinstance(message, PixelsMessage):
        return _depth_kind(message) is not None
    head = bytes(_without_header(message)[:64])
    is_called_depth = "compressedDepth" in message.format or message.format.startswith(tuple(_DEPTH))
    return is_called_depth or png.is_grey16(head) or _is_float_tiff(message)


def is_mono16(message: ImageMessage) -> bool:
    """Return whether an image is called grey of 16 bits, as infrared ones are, and some of depth."""
    return encoding_of(message).startswith("mono16")


def unused_bits(message: ImageMessage, *, where: str) -> int:
    """Return how far a grey image of 16 bits is shifted to use 8: sensors of 10 or 12 leave the others 0.

    Raises:
        FrameError: The image is damaged.
    """
    if not is_depth(message) or has_float_depth(message):
        return 8
    return max(int(np.percentile(_units(message, where=where), 99.9)).bit_length() - 8, 0)


def encoding_of(message: ImageMessage) -> str:
    """Return what an image is called to be encoded as."""
    return message.encoding if isinstance(message, PixelsMessage) else message.format


def size_of(message: ImageMessage, *, where: str) -> tuple[int, int]:
    """Return an image's width and height in pixels.

    Raises:
        FrameError: It is an image file that cannot be decoded.
    """
    if isinstance(message, PixelsMessage):
        if message.width_px < 1 or message.height_px < 1:
            raise FrameError(f"{where}: an image of {message.width_px}×{message.height_px} px")
        return message.width_px, message.height_px
    if is_depth(message):
        height_px, width_px = depth_m_of(message, units_per_m=MM_PER_M, where=where).shape
    else:
        height_px, width_px = image_of(message, colour=False, where=where).shape
    return width_px, height_px


def image_of(message: ImageMessage, *, colour: bool, shift: int = 8, where: str) -> Image:
    """Return an image as (H, W, 3) RGB, or as (H, W) grey if it is or shall be.

    Args:
        message: Pixels or a file; one channel of 16 bits is grey.
        colour: False returns a grey image.
        shift: Bits below those that are used of one channel of 16.
        where: Name of the image in an error.

    Raises:
        FrameError: The image is damaged, or in an encoding that is not read.
    """
    if is_depth(message) and not has_float_depth(message):
        grey: Image = np.minimum(_units(message, where=where) >> shift, 255).astype(np.uint8)
        return grey
    if isinstance(message, FileMessage):
        data = bytes(message.data)
        _refuse_video(data, message.format, where=where)
        return decode_colour(data, where) if colour else decode_grey(data, where)
    name = message.encoding.strip()
    lower = name.lower()
    encoding = _COLOUR.get(name) or _COLOUR.get(_COLOUR_ALIASES.get(lower, lower))
    if encoding is None:
        data = bytes(message.data)
        if data.startswith(_IMAGE_STARTS[:2]):  # of a webcam's driver
            return decode_colour(data, where) if colour else decode_grey(data, where)
        raise FrameError(f"{where}: colour encoded as {message.encoding!r}; known are {', '.join(_COLOUR)}")
    order = ">" if message.is_big_endian else "<"
    pixels = _pixels(message, order + encoding.kind, encoding.channels, rows=encoding.rows, where=where)
    if not pixels.size:
        raise FrameError(f"{where}: an image of {message.width_px}×{message.height_px} px")
    pixels = np.ascontiguousarray(pixels if encoding.kind == "u1" else pixels >> 8, dtype=np.uint8)
    code = encoding.to_rgb if colour else encoding.to_grey
    try:
        return pixels if code is None else cv2.cvtColor(pixels, code)
    except cv2.error:  # colours of two pixels, in each direction, are stored together
        raise FrameError(
            f"{where}: {message.encoding} of {message.width_px}×{message.height_px} px, want even numbers"
        ) from None


def depth_m_of(
    message: ImageMessage, *, units_per_m: float, float_units_per_m: float = 1.0, where: str
) -> DepthImage:
    """Return (H, W) float32 depth in metres; 0 is no measurement.

    Args:
        message: 16-bit units, 32-bit numbers, or a file of either.
        units_per_m: 16-bit units of a metre; ROS says 1000.
        float_units_per_m: Units of 32-bit numbers; ROS says 1.
        where: Name of the image in an error.

    Raises:
        FrameError: The image is damaged, or in an encoding that is not read.
    """
    if isinstance(message, FileMessage):
        return _depth_m_of_file(
            message, units_per_m=units_per_m, float_units_per_m=float_units_per_m, where=where
        )
    units = _units(message, where=where)
    if units.dtype.kind == "f":
        return valid_depth(units, float_units_per_m, where=where)
    return depth_m_from(units, units_per_m)


def _units(message: ImageMessage, *, where: str) -> NDArray[Any]:
    """Return (H, W) numbers as an image of one channel has them, whole ones as uint16."""
    if isinstance(message, FileMessage):
        return decode_depth(bytes(_without_header(message)), where)
    kind = _depth_kind(message)
    if kind is None:
        raise FrameError(f"{where}: depth encoded as {message.encoding}; known are {', '.join(_DEPTH)}")
    order = ">" if message.is_big_endian else "<"
    pixels = _pixels(message, order + kind, 1, where=where)
    if kind.startswith("f"):
        return pixels
    if pixels.itemsize == 2 and are_swapped(pixels):
        pixels = pixels.byteswap()  # drivers label what they do not swap, and the other way round
    return np.ascontiguousarray(pixels if kind == "u2" else np.clip(pixels, 0, SATURATED), dtype=np.uint16)


def _depth_kind(message: PixelsMessage) -> str | None:
    """Return NumPy's name of the numbers of a depth image; None of other images."""
    return _DEPTH_KINDS.get(message.encoding.strip().lower())


def depth_file_of(message: ImageMessage) -> bytes | None:
    """Return the PNG of 16-bit units in a message; None where depth is stored in another way."""
    if isinstance(message, PixelsMessage) or has_float_depth(message):
        return None
    data = bytes(_without_header(message))
    return data if data.startswith(png.SIGNATURE) else None


def has_float_depth(message: ImageMessage) -> bool:
    """Return whether depth is stored as 32-bit numbers, or was before it was compressed."""
    if isinstance(message, PixelsMessage):
        return (_depth_kind(message) or "").startswith("f")
    return message.format.startswith("32FC1") or _is_float_tiff(message)


def _without_header(message: FileMessage) -> memoryview:
    """Return the image file, which in compressedDepth follows a header."""
    begins_late = message.data[DEPTH_HEADER.size :][: len(png.SIGNATURE)] == png.SIGNATURE
    return message.data[DEPTH_HEADER.size if begins_late else 0 :]


def _is_float_tiff(message: FileMessage) -> bool:
    with suppress(FrameError):
        is_tiff = bytes(message.data[:4]) in _TIFF_STARTS
        return is_tiff and decode_depth(bytes(message.data), "").dtype == np.float32
    return False


def _depth_m_of_file(
    message: FileMessage, *, units_per_m: float, float_units_per_m: float, where: str
) -> DepthImage:
    """Decode a PNG, a TIFF or RVL.

    compressedDepth stores 32-bit depth as A / depth + B in 16 bits, with A and B in its header.
    """
    if "compressedDepth" in message.format and len(message.data) < DEPTH_HEADER.size:
        raise FrameError(f"{where}: compressedDepth of {len(message.data)} bytes")
    if "compressedDepth" in message.format and "rvl" in message.format:
        file = bytes(message.data[DEPTH_HEADER.size :])
        units: NDArray[Any] = decode_rvl(file, where)
    else:
        file = bytes(_without_header(message))
        _refuse_video(file, message.format, where=where)
        units = decode_depth(file, where)
    if units.dtype == np.float32:
        return valid_depth(units.astype(np.float32), float_units_per_m, where=where)
    if not message.format.startswith("32FC1") or len(file) == len(message.data):
        return depth_m_from(units.astype(np.uint16, copy=False), units_per_m)
    _, a, b = DEPTH_HEADER.unpack_from(message.data)
    with np.errstate(divide="ignore"):
        depth_m = np.float32(a) / (units.astype(np.float32) - np.float32(b))
    return valid_depth(np.where(units > 0, depth_m, np.float32(0.0)), float_units_per_m, where=where)


def _refuse_video(data: bytes, format_: str, *, where: str) -> None:
    """Refuse data that is no image file: a frame of a video shows only what changed."""
    if data and not data.startswith(_IMAGE_STARTS):
        raise FrameError(
            f"{where}: its format is {format_!r}, which is no image file; "
            "video is not read: record raw images, JPEG or PNG"
        )


def _pixels(
    message: PixelsMessage, kind: str, channels: int, *, rows: Fraction = Fraction(1), where: str
) -> NDArray[Any]:
    """Return a view of an image's rows as (H, W) or (H, W, channels), whatever their padding."""
    pixel = np.dtype(kind)
    height = math.ceil(message.height_px * rows)
    shape = (height, message.width_px, channels)
    used_bytes = message.width_px * channels * pixel.itemsize
    row_bytes = message.row_bytes or used_bytes
    if len(message.data) == height * used_bytes:
        row_bytes = used_bytes  # whatever the message says: without padding there is one way to read it
    strides = (row_bytes, channels * pixel.itemsize, pixel.itemsize)
    try:
        if not len(message.data):
            raise ValueError("no data")  # for which NumPy checks no size, and takes what memory holds
        if message.height_px > 1 and row_bytes < used_bytes:
            raise ValueError("rows overlap")  # a copy of them could be of any size
        pixels = np.ndarray(shape, pixel, buffer=message.data, strides=strides)
    except (TypeError, ValueError):
        raise FrameError(
            f"{where}: an image of {message.width_px}×{message.height_px} px {message.encoding} in rows of "
            f"{message.row_bytes} bytes, but {len(message.data)} bytes are there"
        ) from None
    return pixels[:, :, 0] if channels == 1 else pixels
