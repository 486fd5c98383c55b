"""Scan window: the dense scratch grid in which one scan is rasterised before the map is updated.

A ray loop that looks every voxel up in a hash table is slow. Here a voxel's cell is the union of three masked
integers, and a step along an axis adds one number to one of them. The grid wraps around at powers of two, so
scans may lie anywhere. Cells are in Morton order while all axes have bits left; the lowest nine bits number
the voxels of a block.
"""

import mmap
from contextlib import suppress
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import MapSizeError
from mapper.octree.keys import BLOCK_BITS, BLOCK_VOXELS, KEY_BITS, KEY_MASK, morton

UNTOUCHED, FREE, OCCUPIED = 0, 1, 2
"""States of a cell after a scan, ordered so that occupied wins."""

_LIMIT_BYTES = 1 << 33
"""Address space, not memory: only pages that a ray crosses are ever backed by memory."""


class Window(NamedTuple):
    """The arrays of a window around one scan, for compiled code.

    Attributes:
        cells: (C,) uint8, all UNTOUCHED between scans.
        touched: (C / 512,) uint8, 1 for each block with a cell that is not UNTOUCHED.
        base: (3,) int64 lowest key of the block that holds the ray origin; its cell is 0.
        wrap: (3,) int64 cells per axis − 1.
        bits: (3,) int64 mask of the bits of a cell's index that belong to each axis.
        cell_bits: (3, S) int64 index of each axis's n-th cell: n with its bits deposited into ``bits``.
        offsets: (4, 256) int64 the inverse for blocks: the share of each byte of a block's position in its
            offset from ``base``, x in bits 0 … 15, y in 16 … 31, z in 32 … 47.
    """

    cells: NDArray[np.uint8]
    touched: NDArray[np.uint8]
    base: NDArray[np.int64]
    wrap: NDArray[np.int64]
    bits: NDArray[np.int64]
    cell_bits: NDArray[np.int64]
    offsets: NDArray[np.int64]


class WindowBuffer:
    """Memory of the window, which is kept from scan to scan and only grows."""

    def __init__(self) -> None:
        self._cells = np.zeros(0, dtype=np.uint8)
        self._touched = np.zeros(0, dtype=np.uint8)

    @property
    def memory_bytes(self) -> int:
        """Bytes of address space held."""
        return self._cells.nbytes + self._touched.nbytes

    def window(
        self, lowest: NDArray[np.int64], highest: NDArray[np.int64], *, origin: NDArray[np.int64]
    ) -> Window:
        """Return a window in which no two voxels between two corners share a cell.

        Args:
            lowest: (3,) smallest keys that rays can reach.
            highest: (3,) largest keys that rays can reach.
            origin: (3,) key of the rays' origin.

        Raises:
            MapSizeError: The scan is too large for its resolution; nothing has been allocated then.
        """
        blocks = (highest >> BLOCK_BITS) - (lowest >> BLOCK_BITS) + 1
        lengths = tuple(BLOCK_BITS + (int(n) - 1).bit_length() for n in blocks)
        size = 1 << sum(lengths)
        extent = "×".join(str(n) for n in highest - lowest + 1)
        if size > _LIMIT_BYTES:
            raise MapSizeError(
                f"a scan of {extent} voxels needs {size / 2**30:.0f} GiB of working space, "
                f"the limit is {_LIMIT_BYTES >> 30}; raise resolution_m or lower max_range_m"
            )
        if size > len(self._cells):
            try:
                self._cells = sparse_zeros(size)
            except OSError:
                raise MapSizeError(
                    f"a scan of {extent} voxels needs {size / 2**30:.0f} GiB of address space, which the "
                    "system refuses; raise resolution_m or lower max_range_m"
                ) from None
            self._touched = np.zeros(size // BLOCK_VOXELS, dtype=np.uint8)
        bits, cell_bits, offsets = _layout(lengths)
        base = origin >> BLOCK_BITS << BLOCK_BITS
        wrap = np.array([(1 << n) - 1 for n in lengths], dtype=np.int64)
        return Window(
            self._cells[:size], self._touched[: size // BLOCK_VOXELS], base, wrap, bits, cell_bits, offsets
        )


def sparse_zeros(size: int) -> NDArray[np.uint8]:
    """Return (size,) zeros that take memory only where they are written.

    ``np.zeros`` allocates huge pages: a ray that enters one would pay for clearing and keeping 2 MiB.
    """
    advice = getattr(mmap, "MADV_NOHUGEPAGE", None)
    if advice is None:  # no Linux
        return np.zeros(size, dtype=np.uint8)
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with suppress(OSError):  # a kernel without huge pages refuses advice about them
        memory.madvise(advice)
    return np.frombuffer(memory, dtype=np.uint8)


@lru_cache(maxsize=64)
def _layout(lengths: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return (bits, cell_bits, offsets) of a window with 2^n cells per axis, interleaved from the bottom."""
    bits = np.zeros(3, dtype=np.int64)
    cell_bits = np.zeros((3, 1 << max(lengths)), dtype=np.int64)
    offsets = np.zeros((4, 256), dtype=np.int64)
    position = 0
    for level in range(max(lengths)):
        for axis in range(3):
            if level < lengths[axis]:
                n = np.arange(1 << lengths[axis])
                cell_bits[axis, : len(n)] |= (n >> level & 1) << position
                bits[axis] |= 1 << position
                if level >= BLOCK_BITS:
                    byte, bit = divmod(position - 3 * BLOCK_BITS, 8)
                    offsets[byte] += (np.arange(256) >> bit & 1) << (level - BLOCK_BITS + KEY_BITS * axis)
                position += 1
    return bits, cell_bits, offsets


@njit(cache=True, nogil=True)
def cell_of(window, x, y, z):
    """Return the cell of three keys."""
    return (
        window.cell_bits[0, (x - window.base[0]) & window.wrap[0]]
        | window.cell_bits[1, (y - window.base[1]) & window.wrap[1]]
        | window.cell_bits[2, (z - window.base[2]) & window.wrap[2]]
    )


def take_touched(window: Window) -> NDArray[np.int64]:
    """Return the (B,) positions of the touched blocks and reset their marks."""
    positions: NDArray[np.int64] = np.flatnonzero(window.touched.view(np.bool_))
    window.touched[positions] = 0
    return positions


@njit(cache=True, nogil=True)
def block_codes(window, positions, lowest):
    """Return the (B,) Morton codes of blocks.

    Args:
        window: The window with the blocks.
        positions: (B,) int64 positions of the blocks in it.
        lowest: (3,) int64 smallest keys of the window, which resolve the wrap-around.
    """
    codes = np.empty(len(positions), np.int64)
    for i in range(len(positions)):
        packed = 0
        for byte in range(4):
            packed += window.offsets[byte, (positions[i] >> (8 * byte)) & 0xFF]
        codes[i] = morton(
            _unwrapped(window, lowest, packed, 0),
            _unwrapped(window, lowest, packed, 1),
            _unwrapped(window, lowest, packed, 2),
        )
    return codes


@njit(cache=True, nogil=True)
def _unwrapped(window, lowest, packed, axis):
    """Return a block's key along one axis: the key of any of its voxels without the lowest three bits."""
    offset = (packed >> (KEY_BITS * axis)) & KEY_MASK
    first = lowest[axis] >> BLOCK_BITS
    beyond = (window.base[axis] >> BLOCK_BITS) + offset - first
    return (first + (beyond & (window.wrap[axis] >> BLOCK_BITS))) & (KEY_MASK >> BLOCK_BITS)
