"""Depth images in RVL (Wilson 2017, "Fast Lossless Depth Image Compression"), as compressedDepth has them."""

import struct

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError

_SIZE = struct.Struct("<II")
_MOST_PIXELS = 1 << 26
"""No depth camera has more; an image of zeros takes few bytes, whatever size it states."""
_MOST_NIBBLES = 11
"""Of a number of 32 bits, three in each."""


def decode_rvl(data: bytes, where: str) -> NDArray[np.uint16]:
    """Return the (H, W) units of an image: its columns and rows (uint32), then its pixels.

    Pixels are counts of zeros and of measured ones in turn, the latter followed by their differences, each
    from the one measured before.

    Raises:
        FrameError: It has no pixels, too many, or others than it says.
    """
    if len(data) < _SIZE.size:
        raise FrameError(f"{where}: RVL of {len(data)} bytes")
    columns, rows = _SIZE.unpack_from(data)
    if not 0 < columns * rows <= _MOST_PIXELS:
        raise FrameError(f"{where}: RVL of {columns}×{rows} px; want 1 to {_MOST_PIXELS} in all")
    numbers = _numbers(data[_SIZE.size :])
    is_measured = np.zeros(columns * rows, np.bool_)
    is_difference = np.zeros(len(numbers), np.bool_)
    at, pixel = 0, 0
    while pixel < len(is_measured):
        zeros, count = numbers[at : at + 2].tolist() if at + 1 < len(numbers) else (0, 0)
        first, at = pixel + zeros, at + 2
        if zeros + count == 0 or first + count > len(is_measured) or at + count > len(numbers):
            raise FrameError(f"{where}: RVL of {columns}×{rows} px is damaged, from pixel {pixel} on")
        is_measured[first : first + count] = True
        is_difference[at : at + count] = True
        at, pixel = at + count, first + count
    folded = numbers[is_difference]  # 0, -1, 1, -2 … are 0, 1, 2, 3 …
    units = np.zeros(len(is_measured), np.uint16)
    units[is_measured] = np.cumsum((folded >> 1) ^ -(folded & 1)).astype(np.uint16)
    return units.reshape(rows, columns)


def _numbers(data: bytes) -> NDArray[np.int64]:
    """Return the numbers in words of 32 bits, whose highest nibble is first.

    A number is stored in nibbles of three bits, the lowest first; a fourth bit says that another follows.
    """
    words = np.frombuffer(data, "<u4", len(data) // 4).astype(">u4").view(np.uint8)
    nibbles = np.column_stack([words >> 4, words & 15]).ravel()
    last = np.flatnonzero(nibbles < 8)
    lengths = np.diff(last, prepend=-1)
    sizes = np.minimum(lengths, _MOST_NIBBLES)
    numbers = np.zeros(len(last), np.int64)
    for place in range(int(sizes.max(initial=0))):
        has = np.flatnonzero(sizes > place)
        numbers[has] |= (nibbles[last[has] - lengths[has] + 1 + place].astype(np.int64) & 7) << 3 * place
    return numbers
