"""Compiled queries of the map: log-odds of points, rays, nearest obstacles, and nodes of coarser levels."""

from math import sqrt

import numpy as np
from numba import njit
from numpy import float32, float64, int16, int64
from numpy.typing import NDArray

from mapper.core.voxel_index import VACANT
from mapper.octree.keys import (
    BLOCK_BITS,
    BLOCK_EDGE,
    BLOCK_VOXELS,
    KEY_COUNT,
    KEY_MASK,
    KEY_ZERO,
    centre_of,
    gather,
    have_keys,
    keys_of,
    morton,
)
from mapper.octree.ray_casting_kernels import CHUNK, NEVER
from mapper.octree.sparse_grid import slot_of

_OFFSETS: NDArray[np.int64] = keys_of(np.arange(BLOCK_VOXELS))
"""(512, 3) keys of a block's voxels relative to its first, in Morton order."""


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
    x_m, y_m, z_m = np.empty(CHUNK), np.empty(CHUNK), np.empty(CHUNK)
    codes = np.empty(CHUNK, int64)
    for start in range(0, n, CHUNK):
        size = min(CHUNK, n - start)
        for j in range(size):
            point = points_world[start + j]
            x_m[j], y_m[j], z_m[j] = point[0], point[1], point[2]
        for j in range(size):  # this loop vectorises: one array per axis, no branch
            x = np.floor(inverse_resolution * x_m[j]) + KEY_ZERO
            y = np.floor(inverse_resolution * y_m[j]) + KEY_ZERO
            z = np.floor(inverse_resolution * z_m[j]) + KEY_ZERO
            codes[j] = morton(int64(x), int64(y), int64(z)) if have_keys(x, y, z) else int64(-1)
        for j in range(size):
            found[start + j] = _value_at(table, codes[j])
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def cast_rays(table, origins, directions, resolution_m, max_range_m, threshold, through_unknown):
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
        (N, 3) int64 key of the last voxel, and (N,) whether it is occupied: the others are unknown, or at the
        end of the range or of the keys.
    """
    n = len(origins)
    last = np.empty((n, 3), int64)
    hits = np.zeros(n, np.bool_)
    step, key = np.empty(3, int64), np.empty(3, int64)
    t_max, t_delta = np.empty(3), np.empty(3)
    for i in range(n):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        norm = float32(sqrt(float64(dx * dx + dy * dy + dz * dz)))
        for axis in range(3):
            key[axis] = int64(np.floor((1.0 / resolution_m) * float64(origins[i, axis]))) + KEY_ZERO
            direction = float64(directions[i, axis] / norm)
            step[axis] = int64(np.sign(direction))
            t_max[axis] = t_delta[axis] = NEVER
            if step[axis] != 0:
                border = centre_of(key[axis], resolution_m) + step[axis] * resolution_m * 0.5
                t_max[axis] = (border - float64(origins[i, axis])) / direction
                t_delta[axis] = resolution_m / abs(direction)
        while True:
            value = _value_at(table, morton(key[0], key[1], key[2]))
            if value >= threshold:
                hits[i] = True
                break
            if value != value and not through_unknown:
                break
            axis = 0 if t_max[0] < t_max[1] else 1
            axis = axis if t_max[axis] < t_max[2] else 2
            if key[axis] + step[axis] < 0 or key[axis] + step[axis] >= KEY_COUNT:
                break
            key[axis] += step[axis]
            t_max[axis] += t_delta[axis]
            square = 0.0
            for j in range(3):
                offset = float32(centre_of(key[j], resolution_m)) - origins[i, j]
                square += float64(offset * offset)
            if square > max_range_m * max_range_m:
                break
        for j in range(3):
            last[i, j] = key[j]
    return last, hits


@njit(cache=True, nogil=True)
def known_voxels(codes, slots, values, lowest):
    """Return the (K, 3) uint16 keys and (K,) float32 log-odds of blocks' known voxels, in the given order.

    Args:
        codes: (B,) int64 Morton codes of the blocks.
        slots: (B,) int64 their rows in ``values``.
        values: (capacity, 512) float32.
        lowest: float32 log-odds below which voxels are left out.
    """
    count = 0
    for b in range(len(slots)):
        for voxel in range(BLOCK_VOXELS):
            count += values[slots[b], voxel] >= lowest  # false where it is NaN
    keys = np.empty((count, 3), np.uint16)
    log_odds = np.empty(count, float32)
    k = 0
    for b in range(len(slots)):
        for voxel in range(BLOCK_VOXELS):
            value = values[slots[b], voxel]
            if value >= lowest:
                code = (codes[b] << (3 * BLOCK_BITS)) | voxel
                for axis in range(3):
                    keys[k, axis] = gather(code >> axis)
                log_odds[k] = value
                k += 1
    return keys, log_odds


@njit(cache=True, nogil=True)
def find_nearest(table, block_codes, points, reach, threshold):
    """Return (N,) int64 Morton codes, −1 where there is none, and (N,) squared distances.

    Lengths are in voxels, and points in keys: a voxel's centre lies at its key. Shells of blocks around a
    point are searched from the inside, until one is further away than the nearest voxel so far.
    """
    # Filled for a block when a search first reaches it: other blocks cost nothing.
    counts, members = (
        np.full(len(block_codes), VACANT, int16),
        np.empty((len(block_codes), BLOCK_VOXELS), int16),
    )
    found, squares = np.full(len(points), -1, int64), np.full(len(points), np.inf)
    home = np.empty(3, int64)
    for i in range(len(points)):
        point = points[i]
        for axis in range(3):
            key = min(max(point[axis] + 0.5, 0.0), float64(KEY_MASK))
            home[axis] = int64(key) >> BLOCK_BITS
        best, nearest = reach * reach, int64(-1)
        shell = 0
        while True:
            # Lower bound of the shell's distance; from a point off the map it is further away.
            gap = max(shell - 1, 0) * float64(BLOCK_EDGE)
            if gap * gap > best:
                break
            if (2 * shell + 1) ** 3 > len(block_codes):
                for slot in range(len(block_codes)):
                    best, nearest = _visit(
                        table, slot, block_codes[slot], counts, members, point, threshold, best, nearest
                    )
                break
            for dz in range(-shell, shell + 1):
                for dy in range(-shell, shell + 1):
                    on_side = abs(dz) == shell or abs(dy) == shell
                    for dx in range(-shell, shell + 1, 1 if on_side else 2 * shell):
                        x, y, z = home[0] + dx, home[1] + dy, home[2] + dz
                        if min(x, y, z) < 0 or max(x, y, z) > (KEY_MASK >> BLOCK_BITS):
                            continue
                        if _gap_square(point, x, y, z) > best:
                            continue
                        code = morton(x, y, z)
                        slot = slot_of(table, code)
                        if slot >= 0:
                            best, nearest = _visit(
                                table, slot, code, counts, members, point, threshold, best, nearest
                            )
            shell += 1
        found[i] = nearest
        if nearest >= 0:
            squares[i] = best
    return found, squares


@njit(cache=True, nogil=True)
def _gap_square(point, x, y, z):
    """Return the squared distance from a point to a block's faces."""
    gap_x = max(x * BLOCK_EDGE - 0.5 - point[0], point[0] - (x * BLOCK_EDGE + BLOCK_EDGE - 0.5), 0.0)
    gap_y = max(y * BLOCK_EDGE - 0.5 - point[1], point[1] - (y * BLOCK_EDGE + BLOCK_EDGE - 0.5), 0.0)
    gap_z = max(z * BLOCK_EDGE - 0.5 - point[2], point[2] - (z * BLOCK_EDGE + BLOCK_EDGE - 0.5), 0.0)
    return gap_x * gap_x + gap_y * gap_y + gap_z * gap_z


@njit(cache=True, nogil=True)
def _visit(table, slot, code, counts, members, point, threshold, best, nearest):
    """Return squared distance and code of the nearest voxel so far, after a block's occupied voxels."""
    if counts[slot] == VACANT:
        counts[slot] = _list_occupied(table.values[slot], threshold, members[slot])
    if counts[slot] == 0:
        return best, nearest
    x, y, z = gather(code), gather(code >> 1), gather(code >> 2)
    if _gap_square(point, x, y, z) > best:
        return best, nearest
    x0, y0, z0 = x * BLOCK_EDGE - point[0], y * BLOCK_EDGE - point[1], z * BLOCK_EDGE - point[2]
    for i in range(counts[slot]):
        voxel = members[slot, i]
        dx, dy, dz = x0 + _OFFSETS[voxel, 0], y0 + _OFFSETS[voxel, 1], z0 + _OFFSETS[voxel, 2]
        square = dx * dx + dy * dy + dz * dz
        if square <= best:
            candidate = (code << (3 * BLOCK_BITS)) | voxel
            if square < best or nearest < 0 or candidate < nearest:
                best, nearest = square, candidate
    return best, nearest


@njit(cache=True, nogil=True)
def _list_occupied(block, threshold, members):
    """Write the numbers of a block's occupied voxels; return their count."""
    count = 0
    for voxel in range(BLOCK_VOXELS):
        members[count] = int16(voxel)
        count += block[voxel] >= threshold
    return int16(count)


@njit(cache=True, nogil=True)
def _join(values, mean):
    """Return the log-odds of the parent of eight nodes; NaN is unknown."""
    total, known, highest = 0.0, 0, float32(-np.inf)
    for i in range(8):
        if values[i] == values[i]:
            known += 1
            total += values[i]
            highest = max(highest, values[i])
    if known == 0:
        return float32(np.nan)
    return float32(total / known) if mean else highest


@njit(cache=True, nogil=True)
def block_nodes(codes, slots, stored, levels, mean):
    """Return codes and values of the known nodes 0 … 3 levels above the voxels."""
    size = BLOCK_VOXELS >> (3 * levels)
    node_codes, node_values = np.empty(len(slots) * size, int64), np.empty(len(slots) * size, float32)
    values = np.empty(BLOCK_VOXELS, float32)
    count = 0
    for b in range(len(slots)):
        values[:] = stored[slots[b]]
        for level in range(levels):
            for i in range(BLOCK_VOXELS >> (3 * (level + 1))):
                values[i] = _join(values[8 * i : 8 * i + 8], mean)
        for i in range(size):
            if values[i] == values[i]:
                node_codes[count] = codes[b] * size + i
                node_values[count] = values[i]
                count += 1
    return node_codes[:count].copy(), node_values[:count].copy()


@njit(cache=True, nogil=True)
def parents_of(codes, values, mean):
    """Return codes and values one level up; codes are in ascending order, and stay so."""
    up_codes, up_values = np.empty(len(codes), int64), np.empty(len(codes), float32)
    children = np.empty(8, float32)
    count, i = 0, 0
    while i < len(codes):
        up_codes[count] = codes[i] >> 3
        children[:] = np.nan
        while i < len(codes) and codes[i] >> 3 == up_codes[count]:
            children[codes[i] & 7] = values[i]
            i += 1
        up_values[count] = _join(children, mean)
        count += 1
    return up_codes[:count], up_values[:count]
