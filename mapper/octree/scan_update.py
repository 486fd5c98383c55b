"""Scan update: the free and occupied voxels of one scan, packed, to be merged again without the scan."""

from dataclasses import dataclass

import numpy as np
from isal import isal_zlib
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.octree.casting import Cast
from mapper.octree.keys import BLOCK_VOXELS
from mapper.octree.window import FREE, OCCUPIED, UNTOUCHED

PACKED_BYTES = BLOCK_VOXELS // 8
"""Bytes of one bit per voxel of a block."""

_LEVEL = 1  # of compression: cells are mostly runs, which higher levels shrink little further


@dataclass(frozen=True, slots=True, eq=False)
class ScanUpdate:
    """Free and occupied voxels of one scan, by block.

    Attributes:
        codes: (B,) int64 Morton codes of the blocks, increasing.
        free: (B, 64) uint8, bit v of a block set where voxel v, in Morton order, is free.
        occupied: (B, 64) uint8, the same where it is occupied.
    """

    codes: NDArray[np.int64]
    free: NDArray[np.uint8]
    occupied: NDArray[np.uint8]

    def __post_init__(self) -> None:
        planes = (len(self.codes), PACKED_BYTES)
        if self.free.shape != planes or self.occupied.shape != planes:
            raise DataError(f"scan update: planes {self.free.shape} and {self.occupied.shape}, want {planes}")

    def __len__(self) -> int:
        """Return the number of blocks."""
        return len(self.codes)

    def cells(self) -> NDArray[np.uint8]:
        """Return the (B · 512,) uint8 cells, as casting writes them into a window."""
        cells = np.empty(len(self) * BLOCK_VOXELS, np.uint8)
        _unpack(self.free.reshape(-1), self.occupied.reshape(-1), cells)
        return cells

    def within(self, codes: NDArray[np.int64]) -> "ScanUpdate":
        """Return the update of some blocks alone, given their increasing codes."""
        kept = np.isin(self.codes, codes, assume_unique=True)
        return ScanUpdate(self.codes[kept], self.free[kept], self.occupied[kept])

    def compressed(self) -> bytes:
        """Return the update as compressed bytes, the same for the same update."""
        steps = np.diff(self.codes, prepend=np.int64(0)).astype("<i8")
        return isal_zlib.compress(steps.tobytes() + self.free.tobytes() + self.occupied.tobytes(), _LEVEL)


def pack(cast: Cast) -> ScanUpdate:
    """Return the update of a cast scan, and reset its window's cells to UNTOUCHED."""
    order = np.argsort(cast.codes)
    free, occupied = (np.empty((len(order), PACKED_BYTES), np.uint8) for _ in range(2))
    _pack(cast.window.cells, cast.positions[order], free, occupied)
    return ScanUpdate(cast.codes[order], free, occupied)


def decompressed(data: bytes, *, blocks: int) -> ScanUpdate:
    """Return the update of a number of blocks from the bytes of ``ScanUpdate.compressed``.

    Raises:
        DataError: The bytes are damaged.
    """
    try:
        plain = isal_zlib.decompress(data)
    except isal_zlib.error as error:  # type: ignore[misc]  # its stub says: an instance
        raise DataError(f"scan update of {blocks} blocks: damaged: {error}") from None
    if len(plain) != blocks * (8 + 2 * PACKED_BYTES):
        raise DataError(f"scan update of {blocks} blocks: damaged: {len(plain)} bytes")
    steps = np.frombuffer(plain, "<i8", count=blocks)
    free, occupied = np.frombuffer(plain, np.uint8, offset=8 * blocks).reshape(2, blocks, PACKED_BYTES)
    return ScanUpdate(np.cumsum(steps), free, occupied)


@njit(cache=True, nogil=True)
def _pack(cells, positions, free, occupied):
    for i in range(len(positions)):
        start = positions[i] * BLOCK_VOXELS
        for byte in range(PACKED_BYTES):
            first = start + 8 * byte
            free_bits, occupied_bits = 0, 0
            for bit in range(8):
                free_bits |= (cells[first + bit] == FREE) << bit
                occupied_bits |= (cells[first + bit] == OCCUPIED) << bit
            free[i, byte], occupied[i, byte] = free_bits, occupied_bits
        cells[start : start + BLOCK_VOXELS] = UNTOUCHED


@njit(cache=True, nogil=True)
def _unpack(free, occupied, cells):
    """Write one cell per bit of the (N,) planes."""
    for i in range(len(free)):
        for bit in range(8):
            cells[8 * i + bit] = ((free[i] >> bit) & 1) * FREE + ((occupied[i] >> bit) & 1) * OCCUPIED
