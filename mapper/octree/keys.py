"""Voxel keys as OctoMap numbers them, and the Morton codes that order them.

A key is ``floor(coordinate / resolution) + 32768`` per axis, 0 … 65535. A Morton code interleaves the three
keys with x lowest, so its base-8 digits, from the top, are the child indices on the way down the octree.
"""

from math import floor

import numpy as np
from numba import njit
from numpy import float64, int64
from numpy.typing import NDArray

KEY_BITS = 16
KEY_COUNT = 1 << KEY_BITS
KEY_ZERO = KEY_COUNT // 2
KEY_MASK = KEY_COUNT - 1

BLOCK_BITS = 3
"""A block is 8³ voxels: the lowest three levels of the tree."""
BLOCK_EDGE = 1 << BLOCK_BITS
BLOCK_VOXELS = BLOCK_EDGE**3
PACKED_BYTES = BLOCK_VOXELS // 8
"""Bytes of one bit per voxel of a block."""
BLOCK_DEPTH = KEY_BITS - BLOCK_BITS
"""Depth of the tree node that a block is."""


@njit(cache=True, nogil=True, inline="always")
def key_of(coordinate_m, inverse_resolution):
    """Return the key of a finite coordinate; OctoMap floors before it adds the offset."""
    return int64(floor(inverse_resolution * float64(coordinate_m))) + KEY_ZERO


@njit(cache=True, nogil=True, inline="always")
def centre_of(key, resolution_m):
    """Return the coordinate of a voxel's centre, float64 metres."""
    return (float64(key - KEY_ZERO) + 0.5) * resolution_m


@njit(cache=True, nogil=True, inline="always")
def have_keys(x, y, z):
    """Return whether three floored coordinates, as float64 keys, lie in the key range; NaN does not."""
    return (x >= 0) & (x < KEY_COUNT) & (y >= 0) & (y < KEY_COUNT) & (z >= 0) & (z < KEY_COUNT)


@njit(cache=True, nogil=True)
def spread(key):
    """Return the 16 bits of a key spread to every third bit."""
    code = key & 0xFFFF
    code = (code | (code << 16)) & 0x0000FF0000FF
    code = (code | (code << 8)) & 0x00F00F00F00F
    code = (code | (code << 4)) & 0x0C30C30C30C3
    return (code | (code << 2)) & 0x249249249249


@njit(cache=True, nogil=True)
def gather(code):
    """Return the key whose bits are every third bit of a code: the inverse of :func:`spread`."""
    key = code & 0x249249249249
    key = (key | (key >> 2)) & 0x0C30C30C30C3
    key = (key | (key >> 4)) & 0x00F00F00F00F
    key = (key | (key >> 8)) & 0x0000FF0000FF
    return (key | (key >> 16)) & 0xFFFF


def keys_of(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the (N, 3) keys of (N,) Morton codes."""
    return np.column_stack([gather.py_func(codes >> axis) for axis in range(3)])


def block_keys(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the (B, 3) key of the lowest voxel of each block, given the blocks' (B,) Morton codes."""
    return keys_of(codes) << BLOCK_BITS


@njit(cache=True, nogil=True)
def morton(x, y, z):
    """Return the Morton code of three keys."""
    return spread(x) | (spread(y) << 1) | (spread(z) << 2)


def codes_of_keys(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the (N,) Morton codes of (N, 3) keys: the inverse of :func:`keys_of`."""
    x, y, z = (spread.py_func(keys[:, axis]) for axis in range(3))
    codes: NDArray[np.int64] = x | (y << 1) | (z << 2)
    return codes


@njit(cache=True, nogil=True)
def codes_of(points_world, resolution_m):
    """Return the (N,) int64 Morton codes of (N, 3) float64 points, metres; −1 is out of range."""
    inverse_resolution = 1.0 / resolution_m
    codes = np.empty(len(points_world), int64)
    for i in range(len(points_world)):
        x = np.floor(inverse_resolution * points_world[i, 0]) + KEY_ZERO
        y = np.floor(inverse_resolution * points_world[i, 1]) + KEY_ZERO
        z = np.floor(inverse_resolution * points_world[i, 2]) + KEY_ZERO
        codes[i] = morton(int64(x), int64(y), int64(z)) if have_keys(x, y, z) else int64(-1)
    return codes
