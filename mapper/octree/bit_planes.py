"""Bit planes: one bit per voxel of a block, and their dilation by a voxel, 64 voxels at a time.

A plane has eight words a block; word k holds the 4³ voxels of the block's octant k, in Morton order. A step
along an axis moves bits by fixed distances inside a word, and the last layer to the first of the next word.
"""

import numpy as np
from numba import njit
from numpy import int64, uint64
from numpy.typing import NDArray

from mapper.core.voxel_index import row_of, voxel_index
from mapper.octree.keys import BLOCK_VOXELS, KEY_MASK, spread

WORD_BITS = 64
WORDS = BLOCK_VOXELS // WORD_BITS
NONE_SET = np.uint64(0)
ALL_SET = ~NONE_SET

Words = NDArray[np.uint64]
"""(B, 8) uint64: a plane of B blocks."""

_AXIS_BITS = int(spread.py_func(KEY_MASK))
"""Bits of a code that belong to x."""


def _layers() -> NDArray[np.uint64]:
    """Return (3, 4) words: the bits whose voxels lie in each of a word's four layers along each axis."""
    layers = np.zeros((3, 4), np.uint64)
    for voxel in range(WORD_BITS):
        for axis in range(3):
            layer = (voxel >> axis & 1) | (voxel >> (3 + axis) & 1) << 1
            layers[axis, layer] |= np.uint64(1 << voxel)
    return layers


_LAYERS = _layers()


def words_of(plane: NDArray[np.uint8]) -> Words:
    """Return a (B, 64) uint8 plane of a scan update as words, sharing its memory."""
    return plane.view("<u8")


def neighbours_of(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return (B, 3, 2) rows of the blocks below and above each block along each axis, −1 where absent."""
    found: NDArray[np.int64] = _neighbours(codes, voxel_index(max(len(codes), 1), codes))
    return found


def dilate(words: Words, neighbours: NDArray[np.int64], *, absent: np.uint64) -> Words:
    """Return a plane with a bit set where one is set among the 27 voxels around, its own included.

    One axis follows another: from a block to one that shares only an edge with it, a bit spreads through the
    block between them, and not if that is absent.

    Args:
        words: The plane.
        neighbours: Its blocks' neighbours, from ``neighbours_of``.
        absent: Every word of blocks that are absent.
    """
    grown: Words = _dilate(words, neighbours, _LAYERS, absent)
    return grown


@njit(cache=True, nogil=True)
def _neighbours(codes, index):
    rows = np.empty((len(codes), 3, 2), int64)
    for i in range(len(codes)):
        for axis in range(3):
            own = int64(_AXIS_BITS) << axis
            others = codes[i] & ~own
            below, above = ((codes[i] & own) - 1) & own, ((codes[i] | ~own) + 1) & own
            rows[i, axis, 0] = row_of(index, others | below)
            rows[i, axis, 1] = row_of(index, others | above)
    return rows


@njit(cache=True, nogil=True)
def _dilate(words, neighbours, layers, absent):
    before = words
    for axis in range(3):
        after = np.empty_like(words)
        one, seven, nine = uint64(1 << axis), uint64(7 << axis), uint64(9 << axis)
        first, second, third, last = layers[axis, 0], layers[axis, 1], layers[axis, 2], layers[axis, 3]
        for i in range(len(words)):
            lower, upper = neighbours[i, axis, 0], neighbours[i, axis, 1]
            for k in range(WORDS):
                other = k ^ (1 << axis)
                if k & (1 << axis):
                    below = before[i, other]
                    above = absent if upper < 0 else before[upper, other]
                else:
                    below = absent if lower < 0 else before[lower, other]
                    above = before[i, other]
                word = before[i, k]
                word |= (
                    ((word & (first | third)) << one)
                    | ((word & second) << seven)
                    | ((word & (second | last)) >> one)
                    | ((word & third) >> seven)
                )
                after[i, k] = word | ((below & last) >> nine) | ((above & first) << nine)
        before = after
    return before
