"""Compiled look-ups in the map: log-odds of points, and rays that stop at obstacles."""

from math import sqrt

import numpy as np
from numba import njit
from numpy import float32, float64, int64

from mapper.octree.blocks import slot_of
from mapper.octree.keys import (
    BLOCK_BITS,
    BLOCK_VOXELS,
    KEY_COUNT,
    KEY_ZERO,
    centre_of,
    gather,
    have_keys,
    morton,
)

HIT, STOPPED_UNKNOWN, STOPPED_RANGE = 1, 2, 3
"""Outcomes of a ray: it ended in an occupied voxel, in an unknown one, or at the range or map's border."""

_CHUNK = 256  # points worked on at a time: their codes stay in the first-level cache
_NOWHERE = int64(1) << 60  # a Morton code that no voxel has
_NEVER = float64(np.finfo(np.float64).max)


@njit(cache=True, nogil=True)
def _value_at(table, code):
    """Return the log-odds of a voxel by its Morton code; NaN is unknown."""
    slot = slot_of(table, code >> (3 * BLOCK_BITS))
    value = table.values[max(slot, 0), code & (BLOCK_VOXELS - 1)]  # read anyway: a branch would cost more
    return value if slot >= 0 else float32(np.nan)


@njit(cache=True, nogil=True)
def values_at(table, points_world, resolution_m):
    """Return the (N,) float32 log-odds of (N, 3) float64 points, metres; NaN is unknown or out of range."""
    n = len(points_world)
    inverse_resolution = 1.0 / resolution_m
    found = np.empty(n, float32)
    x_m, y_m, z_m = np.empty(_CHUNK), np.empty(_CHUNK), np.empty(_CHUNK)
    codes = np.empty(_CHUNK, int64)
    for start in range(0, n, _CHUNK):
        size = min(_CHUNK, n - start)
        for j in range(size):
            point = points_world[start + j]
            x_m[j], y_m[j], z_m[j] = point[0], point[1], point[2]
        for j in range(size):  # this loop vectorises: one array per axis, no branch
            x = np.floor(inverse_resolution * x_m[j]) + KEY_ZERO
            y = np.floor(inverse_resolution * y_m[j]) + KEY_ZERO
            z = np.floor(inverse_resolution * z_m[j]) + KEY_ZERO
            codes[j] = morton(int64(x), int64(y), int64(z)) if have_keys(x, y, z) else _NOWHERE
        for j in range(size):
            found[start + j] = _value_at(table, codes[j])
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def first_obstacles(table, origins, directions, resolution_m, max_range_m, threshold, through_unknown):
    """Follow rays voxel by voxel as OctoMap's ``castRay`` does (Amanatides & Woo 1987).

    Args:
        table: The map.
        origins: (N, 3) float32 metres, inside the key range.
        directions: (N, 3) float32, any length but zero.
        resolution_m: Voxel edge.
        max_range_m: From the origin to the last voxel's centre.
        threshold: Log-odds from which a voxel is occupied.
        through_unknown: Whether rays pass unknown voxels.

    Returns:
        (N, 3) int64 key of the last voxel and (N,) uint8 outcome of the ray.
    """
    n = len(origins)
    last = np.empty((n, 3), int64)
    outcome = np.empty(n, np.uint8)
    step, key = np.empty(3, int64), np.empty(3, int64)
    time, delta = np.empty(3), np.empty(3)
    for i in range(n):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        norm = float32(sqrt(float64(dx * dx + dy * dy + dz * dz)))
        for axis in range(3):
            key[axis] = int64(np.floor((1.0 / resolution_m) * float64(origins[i, axis]))) + KEY_ZERO
            direction = float64(directions[i, axis] / norm)
            step[axis] = int64(np.sign(direction))
            time[axis] = delta[axis] = _NEVER
            if step[axis] != 0:
                border = centre_of(key[axis], resolution_m) + step[axis] * resolution_m * 0.5
                time[axis] = (border - float64(origins[i, axis])) / direction
                delta[axis] = resolution_m / abs(direction)
        while True:
            value = _value_at(table, morton(key[0], key[1], key[2]))
            if value >= threshold:
                outcome[i] = HIT
                break
            if value != value and not through_unknown:
                outcome[i] = STOPPED_UNKNOWN
                break
            axis = 0 if time[0] < time[1] else 1
            axis = axis if time[axis] < time[2] else 2
            if key[axis] + step[axis] < 0 or key[axis] + step[axis] >= KEY_COUNT:
                outcome[i] = STOPPED_RANGE
                break
            key[axis] += step[axis]
            time[axis] += delta[axis]
            square = 0.0
            for j in range(3):
                offset = float32(centre_of(key[j], resolution_m)) - origins[i, j]
                square += float64(offset * offset)
            if square > max_range_m * max_range_m:
                outcome[i] = STOPPED_RANGE
                break
        for j in range(3):
            last[i, j] = key[j]
    return last, outcome


@njit(cache=True, nogil=True)
def known_voxels(codes, slots, values):
    """Return the (K, 3) uint16 keys and (K,) float32 log-odds of blocks' known voxels, in the given order.

    Args:
        codes: (B,) int64 Morton codes of the blocks.
        slots: (B,) int64 their rows in ``values``.
        values: (capacity, 512) float32.
    """
    count = 0
    for b in range(len(slots)):
        for voxel in range(BLOCK_VOXELS):
            count += values[slots[b], voxel] == values[slots[b], voxel]
    keys = np.empty((count, 3), np.uint16)
    log_odds = np.empty(count, float32)
    k = 0
    for b in range(len(slots)):
        for voxel in range(BLOCK_VOXELS):
            value = values[slots[b], voxel]
            if value == value:
                code = (codes[b] << (3 * BLOCK_BITS)) | voxel
                for axis in range(3):
                    keys[k, axis] = gather(code >> axis)
                log_odds[k] = value
                k += 1
    return keys, log_odds
