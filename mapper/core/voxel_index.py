"""Voxel index: a compiled hash table from the int64 keys of voxels to row numbers.

Open addressing with linear probing. Rows number the keys in the order in which they were added, so that data
stored by row do not depend on the hash. Neighbouring voxels mostly have neighbouring rows: that is why keys
are stored by row, and the table has rows alone.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

AXIS_BITS = 21
"""Bits of each coordinate in a ``cell_key``; cells 2²¹ apart along an axis have the same key."""
HALF_SPAN = 1 << (AXIS_BITS - 1)
"""Cells on either side of the origin; within, a position in cells is exact to a millionth of one."""

FIBONACCI = -7046029254386353131
"""2⁶⁴/φ as int64: a product with it spreads neighbouring keys (Knuth, TAOCP vol. 3, §6.4)."""

VACANT = -1


class VoxelIndex(NamedTuple):
    """The arrays of an index, for compiled code.

    Attributes:
        rows: (C,) int32 rows by the hash of their keys, −1 where vacant. C is a power of two, at least twice
            the capacity.
        keys: (capacity,) int64 keys by row.
    """

    rows: NDArray[np.int32]
    keys: NDArray[np.int64]


def voxel_index(capacity: int, keys: NDArray[np.int64] | None = None) -> VoxelIndex:
    """Return an index with room for a number of keys, of which (N,) distinct ones get the rows 0 … N − 1."""
    rows = np.full(1 << (2 * capacity - 1).bit_length(), VACANT, np.int32)
    index = VoxelIndex(rows, np.empty(capacity, np.int64))
    if keys is not None:
        _add(index, keys)
    return index


@njit(cache=True, nogil=True)
def cell_key(x, y, z):
    """Return the key of the cell around a point whose coordinates are counted in cells."""
    mask = (1 << AXIS_BITS) - 1
    return (
        ((np.int64(np.floor(x)) & mask) << (2 * AXIS_BITS))
        | ((np.int64(np.floor(y)) & mask) << AXIS_BITS)
        | (np.int64(np.floor(z)) & mask)
    )


@njit(cache=True, nogil=True)
def cell_of(key):
    """Return the three coordinates of a cell, counted in cells, by its key."""
    upper = 64 - AXIS_BITS
    return (
        (key << (upper - 2 * AXIS_BITS)) >> upper,
        (key << (upper - AXIS_BITS)) >> upper,
        (key << upper) >> upper,
    )


@njit(cache=True, nogil=True)
def _slot_of(index, key):
    """Return the number of the table's entry with a key's row, or of the vacant one where it belongs."""
    mask = len(index.rows) - 1
    # Folded, since the product's middle bits do not depend on the key's highest ones.
    slot = (((key ^ (key >> 32)) * FIBONACCI) >> 32) & mask
    while index.rows[slot] != VACANT and index.keys[index.rows[slot]] != key:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def row_of(index, key):
    """Return the row of a key, or −1."""
    return np.int64(index.rows[_slot_of(index, key)])


@njit(cache=True, nogil=True)
def claim_row(index, key, count):
    """Return the row of a key; an absent key is added with the row ``count``, the number of keys so far."""
    slot = _slot_of(index, key)
    if index.rows[slot] == VACANT:
        index.rows[slot], index.keys[count] = count, key
    return np.int64(index.rows[slot])


@njit(cache=True, nogil=True)
def _add(index, keys):
    for row in range(len(keys)):
        claim_row(index, keys[row], row)
