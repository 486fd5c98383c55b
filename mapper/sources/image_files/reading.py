"""Image files as arrays: whole and of the right kind, or an error that names the file."""

from collections.abc import Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError, FrameError
from mapper.core.frames import DepthImage, Image
from mapper.core.units import MM_PER_M
from mapper.runtime.regular_files import MOST_BYTES, read_regular
from mapper.sources.base import ImageFile
from mapper.sources.cloud_files.parsing import MAX_RANGE_M, load_array
from mapper.sources.image_files import exr, jpeg, png
from mapper.sources.image_files.decoded import SATURATED, DecodedColour, DecodedDepth
from mapper.sources.image_files.size import check_pixels

TUM_UNITS_PER_M = 5000.0
"""16-bit units of a metre in which depth in metres goes into files: 0.2 mm (Sturm et al. 2012)."""

ARRAYS = (".npy", ".tif", ".tiff", ".pfm", ".exr")
"""Endings of depth images that may be of floating-point numbers."""

# A camera's calibration holds for the pixels as stored, so a rotation tag must not turn them.
_RGB = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
_GREY = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
_ROW_STEP, _LESS_SMOOTH = 8, 4.0
"""Rows looked at, and how much more neighbours differ where bytes are swapped: by 40 times and more."""
_PNG_END = b"IEND\xae\x42\x60\x82"


def read_colour(path: ImageFile) -> Image:
    """Return the (H, W, 3) uint8 RGB image of a file.

    Raises:
        FrameError: The file is missing, empty, cut short, damaged or not an image.
    """
    if isinstance(path, DecodedColour):
        return path.decode(True)
    return decode_colour(bytes_of(path), f"{path}")


def decode_colour(data: bytes, where: str) -> Image:
    """Return the (H, W, 3) uint8 RGB image of a file's bytes; ``where`` is what an error names.

    Raises:
        FrameError: As :func:`read_colour`.
    """
    return _eight_bit(_decoded(data, _RGB, where), where)


def read_grey(path: ImageFile) -> Image:
    """Return the (H, W) uint8 luminance of a file; cheaper than colour for a JPEG.

    Raises:
        FrameError: As :func:`read_colour`.
    """
    if isinstance(path, DecodedColour):
        return path.decode(False)
    return decode_grey(bytes_of(path), f"{path}")


def decode_grey(data: bytes, where: str) -> Image:
    """Return the (H, W) uint8 luminance of a file's bytes; ``where`` is what an error names.

    Raises:
        FrameError: As :func:`read_colour`.
    """
    image = _eight_bit(_decoded(data, _GREY, where), where)
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return image


def read_view(path: ImageFile, in_colour: bool) -> Image:
    """Return the image of a file as ``read_colour`` or ``read_grey``, but of 16 bits the upper 8 (TUM-VI's).

    It is for logs without depth images, for which an image of 16 bits may be taken otherwise.

    Raises:
        FrameError: As :func:`read_colour`.
    """
    if isinstance(path, DecodedColour):
        return path.decode(in_colour)
    data, where = bytes_of(path), f"{path}"
    if not (png.is_plain(data) and png.is_grey16(data)):  # OpenCV takes the upper bits itself
        return decode_colour(data, where) if in_colour else decode_grey(data, where)
    upper = (_decoded(data, _GREY, where) >> 8).astype(np.uint8)
    return np.asarray(cv2.cvtColor(upper, cv2.COLOR_GRAY2RGB), np.uint8) if in_colour else upper


def read_depth_m(path: ImageFile, units_per_m: float) -> DepthImage:
    """Return the (H, W) float32 depth in metres of a 16-bit image; 0 is no measurement.

    Args:
        path: One-channel 16-bit image, or one that its source decodes.
        units_per_m: Units per metre of the 16-bit image, e.g. 5000 for TUM and 1000 for millimetres.

    Raises:
        FrameError: As :func:`read_colour`, or the image is not one channel of 16 bits.
    """
    if isinstance(path, DecodedDepth):
        return path.decode()
    return depth_m_from(decode_depth_units(bytes_of(path), f"{path}"), units_per_m)


def read_array_m(path: ImageFile, units_per_m: float, float_units_per_m: float) -> DepthImage:
    """Return the (H, W) float32 depth in metres of a file of ``ARRAYS``; 0 and NaN are no measurement.

    Args:
        path: Array of (H, W), (H, W, 1) or (1, H, W) numbers, or an image of 16 bits or floats.
        units_per_m: Units per metre of whole numbers.
        float_units_per_m: Units per metre of others.

    Raises:
        FrameError: The file is missing, damaged or no such array, or all of it is beyond any camera's reach.
    """
    array = _array_of(path)
    if array.dtype == np.uint16:
        return depth_m_from(array, units_per_m)
    unit = float_units_per_m if array.dtype.kind == "f" else units_per_m
    return valid_depth(array, unit, where=f"{path}")


def has_floats(path: ImageFile) -> bool:
    """Return whether a depth image is a file of floating-point numbers; a damaged one is not."""
    with suppress(FrameError):
        return path.suffix in ARRAYS and _array_of(path).dtype.kind == "f"
    return False


def _array_of(path: ImageFile) -> NDArray[Any]:
    """Return the (H, W) numbers of a file of depth.

    Raises:
        FrameError: The file is missing, damaged or no such array.
    """
    data = bytes_of(path)
    array: NDArray[Any]
    if path.suffix == ".npy":
        array = load_array(BytesIO(data), path)
    elif data.startswith(exr.START):
        array = exr.decode(_of_sound_size(data, f"{path}"), f"{path}")
    else:
        array = decode_depth(data, f"{path}")
    if array.ndim == 3 and 1 in (array.shape[0], array.shape[2]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    if array.ndim != 2 or array.dtype.kind not in "uif" or not array.size:
        raise FrameError(f"{path}: array of {array.dtype} {array.shape}, want rows and columns of depth")
    return array


def _of_sound_size(data: bytes, where: str) -> bytes:
    """Return the bytes of an image that may be decoded.

    Raises:
        FrameError: It is too large.
    """
    try:
        check_pixels(data)
    except DataError as error:
        raise FrameError(f"{where}: {error}") from None
    return data


def decode_depth_units(data: bytes, where: str) -> NDArray[np.uint16]:
    """Return the (H, W) units of a 16-bit depth image's bytes; ``where`` is what an error names.

    Raises:
        FrameError: As :func:`read_depth_m`.
    """
    return cast(NDArray[np.uint16], decode_depth(data, where, kinds=(np.uint16,)))


def decode_depth(
    data: bytes, where: str, *, kinds: Sequence[type] = (np.uint16, np.float32)
) -> NDArray[np.uint16] | NDArray[np.float32]:
    """Return the (H, W) 16-bit units or 32-bit numbers of a depth image's bytes.

    Raises:
        FrameError: As :func:`read_colour`, or the image is not one channel of one of these kinds.
    """
    units = _decoded(data, cv2.IMREAD_UNCHANGED, where)
    if units.dtype not in kinds or units.ndim != 2:
        raise FrameError(
            f"{where}: depth image of {units.dtype} {units.shape}, want one channel of 16 bits, as "
            "in a PNG of millimetres"
        )
    return cast(NDArray[np.uint16], units)


def are_swapped(units: NDArray[np.integer]) -> bool:
    """Return whether (H, W) depth of 16 bits is stored in the other order of bytes.

    Neighbours in a row differ little where the order is right; values of one byte may be in either.
    """
    some = np.asarray(units[::_ROW_STEP]).astype(np.uint16)
    swapped = some.byteswap()
    is_measured = (some[:, 1:] > 0) & (some[:, :-1] > 0)
    if not is_measured.any() or np.median(swapped[swapped > 0]) <= np.iinfo(np.uint8).max:
        return False
    apart, swapped_apart = (
        np.abs(np.diff(one.astype(np.int32), axis=1))[is_measured].mean() for one in (some, swapped)
    )
    return bool(apart > _LESS_SMOOTH * swapped_apart)


def depth_m_from(units: NDArray[np.uint16], units_per_m: float) -> DepthImage:
    """Return (H, W) float32 metres of 16-bit units; 0, and what is saturated, is no measurement."""
    depth_m: DepthImage = _metres(units, np.float32(units_per_m))
    return depth_m


def valid_depth(depth: NDArray[np.number], units_per_m: float, *, where: str) -> DepthImage:
    """Return metres, 0 where depth is not finite, negative, or beyond the reach of every depth camera.

    Raises:
        FrameError: All of it is beyond that reach.
    """
    with np.errstate(all="ignore"):  # damaged numbers may be too large, or signalling NaN
        valid: DepthImage = np.array(depth, dtype=np.float32)  # aligned, which a message need not be
        valid /= np.float32(units_per_m)
    is_measured = valid > 0.0
    is_near = is_measured & (valid < MAX_RANGE_M)
    if not is_near.any() and (is_far := is_measured & np.isfinite(valid)).any():
        remedy = "millimetres? --set source.camera.depth_factor=1000 reads them"
        raise FrameError(
            f"{where}: the median depth is {np.median(valid[is_far]):.0f} m by {units_per_m:g} units per "
            f"metre, at most {MAX_RANGE_M:.0f} m can be measured; "
            f"{remedy if units_per_m < MM_PER_M else 'is source.camera.depth_factor right?'}"
        )
    np.copyto(valid, 0.0, where=~is_near)
    return valid


def bytes_of(path: ImageFile) -> bytes:
    """Return an image file's bytes.

    Raises:
        FrameError: The file is missing, cannot be read, is no regular file, or too large.
    """
    try:
        if isinstance(path, Path):
            return read_regular(path, most_bytes=MOST_BYTES)
        return path.read_bytes()
    except OSError as error:
        raise FrameError(f"{path}: cannot be read: {error.strerror}") from None
    except DataError as error:
        raise FrameError(f"{path}: {error}") from None


def image_bytes(path: ImageFile) -> bytes:
    """Return an image file's bytes to be copied into another log: nothing but an image is.

    Raises:
        FrameError: As :func:`bytes_of`, or the file is no image.
    """
    data = bytes_of(path)
    if not data.startswith((png.SIGNATURE, jpeg.START)):
        _decoded(data, cv2.IMREAD_UNCHANGED, f"{path}")
    return data


def _eight_bit(image: NDArray[np.uint8] | NDArray[np.uint16], where: str) -> Image:
    if image.dtype != np.uint8:
        raise FrameError(f"{where}: colour image of {image.dtype} {image.shape}, want 8 bits a channel")
    return cast(Image, image)


def _decoded(data: bytes, flags: int, where: str) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Decode a file; plain PNGs come as they are stored, everything else as the flags, OpenCV's, say."""
    if not data:
        raise FrameError(f"{where}: empty file")
    try:
        check_pixels(data)
        if png.is_plain(data):
            return png.decode(data)
        if data.startswith(jpeg.START):
            return jpeg.decode(data, colour=flags != _GREY)
        _check_whole(data)
        image: NDArray[np.uint8] | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (DataError, cv2.error) as error:
        raise FrameError(f"{where}: {error}") from None
    if image is None:
        raise FrameError(f"{where}: not an image that OpenCV can decode ({len(data)} bytes)")
    return image


def _check_whole(data: bytes) -> None:
    """Refuse a PNG without its last chunk: OpenCV reports truncation on stderr only."""
    tail = data.rstrip(b"\0")[-64:]
    if data.startswith(png.SIGNATURE) and _PNG_END not in tail:
        raise DataError("truncated PNG: it ends before its last chunk")


@njit(cache=True, nogil=True, error_model="numpy")  # Python's check for division by zero bars SIMD
def _metres(units: NDArray[np.uint16], units_per_m: np.float32) -> DepthImage:
    depth_m = np.empty(units.shape, np.float32)
    for y in range(units.shape[0]):
        for x in range(units.shape[1]):
            value = units[y, x]
            depth_m[y, x] = np.float32(0.0) if value == SATURATED else np.float32(value) / units_per_m
    return depth_m
