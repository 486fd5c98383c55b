"""Compiled steps from a scan's points to updated log-odds, equal to OctoMap's to the last bit.

OctoMap (Hornung et al. 2013, release 1.10) computes in a mixture of float32 and float64. The casts below
repeat that mixture; without ``fastmath`` the compiler neither fuses nor reorders them.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy import float32, float64, int32, int64

from mapper.core.voxel_index import FIBONACCI
from mapper.octree.keys import BLOCK_BITS, BLOCK_VOXELS, KEY_COUNT, KEY_ZERO, centre_of, have_keys, key_of
from mapper.octree.window import FREE, OCCUPIED, UNTOUCHED, cell_of

_CHUNK = 256  # points worked on at a time: their scratch arrays stay in the first-level cache
_RECENT = 1 << 15  # entries of the table of recent voxels: 256 KiB
_NEVER = float64(np.finfo(np.float64).max)  # OctoMap's tMax along an axis that the ray does not move on


class SensorModel(NamedTuple):
    """OctoMap's sensor model in float32 log-odds: the increments of a hit and a miss, and the clamps."""

    hit: np.float32
    miss: np.float32
    lowest: np.float32
    highest: np.float32


@njit(cache=True, nogil=True)
def to_world(points_body, T_world_body):
    """Return the (N, 3) float32 points in the world, computed in float64."""
    points_world = np.empty_like(points_body)
    T = T_world_body
    for i in range(len(points_body)):
        x, y, z = float64(points_body[i, 0]), float64(points_body[i, 1]), float64(points_body[i, 2])
        for row in range(3):
            points_world[i, row] = float32(T[row, 0] * x + T[row, 1] * y + T[row, 2] * z + T[row, 3])
    return points_world


@njit(cache=True, nogil=True)
def end_voxels(points_body, T_world_body, resolution_m):
    """Return the centres of the voxels around a scan's points.

    A voxel is listed again if its entry in the table of recent ones was overwritten in between: casting a ray
    twice changes nothing, and a lossy table costs a fraction of an exact one.

    Args:
        points_body: (N, 3) float32 metres, C-contiguous.
        T_world_body: (4, 4) float64.
        resolution_m: Voxel edge.

    Returns:
        (K, 3) float32 voxel centres, world frame, and the number of points that have no key.
    """
    n = len(points_body)
    inverse_resolution = 1.0 / resolution_m
    x, y, z = np.empty(_CHUNK, float32), np.empty(_CHUNK, float32), np.empty(_CHUNK, float32)
    packed, runs = np.empty(_CHUNK + 1, int64), np.empty(_CHUNK + 1, int64)
    recent = np.full(_RECENT, -1, int64)
    found = np.empty(n + 1, int64)
    count, outside = 0, 0
    r00, r01, r02, t0 = T_world_body[0, 0], T_world_body[0, 1], T_world_body[0, 2], T_world_body[0, 3]
    r10, r11, r12, t1 = T_world_body[1, 0], T_world_body[1, 1], T_world_body[1, 2], T_world_body[1, 3]
    r20, r21, r22, t2 = T_world_body[2, 0], T_world_body[2, 1], T_world_body[2, 2], T_world_body[2, 3]
    packed[0] = -1
    for start in range(0, n, _CHUNK):
        size = min(_CHUNK, n - start)
        for j in range(size):
            x[j], y[j], z[j] = points_body[start + j, 0], points_body[start + j, 1], points_body[start + j, 2]
        for j in range(size):  # this loop vectorises: one array per axis, no branch
            bx, by, bz = float64(x[j]), float64(y[j]), float64(z[j])
            wx = float64(float32(r00 * bx + r01 * by + r02 * bz + t0))
            wy = float64(float32(r10 * bx + r11 * by + r12 * bz + t1))
            wz = float64(float32(r20 * bx + r21 * by + r22 * bz + t2))
            kx = np.floor(inverse_resolution * wx) + KEY_ZERO
            ky = np.floor(inverse_resolution * wy) + KEY_ZERO
            kz = np.floor(inverse_resolution * wz) + KEY_ZERO
            outside += int64(not have_keys(kx, ky, kz))
            packed[j + 1] = int64(kx) | (int64(ky) << 16) | (int64(kz) << 32)
        distinct = 0
        for j in range(size):  # neighbouring pixels mostly share a voxel
            runs[distinct] = packed[j + 1]
            distinct += packed[j + 1] != packed[j]
        packed[0] = packed[size]
        for j in range(distinct):
            entry = ((runs[j] * FIBONACCI) >> 40) & (_RECENT - 1)
            found[count] = runs[j]
            count += recent[entry] != runs[j]
            recent[entry] = runs[j]
    centres = np.empty((count, 3), float32)
    for i in range(count):
        for axis in range(3):
            centres[i, axis] = centre_of((found[i] >> (16 * axis)) & 0xFFFF, resolution_m)
    return centres, outside


@njit(cache=True, nogil=True, error_model="numpy")
def clip_rays(ends, origin, resolution_m, max_range_m):
    """Return the stops of rays, which are not longer than the maximum range.

    Args:
        ends: (N, 3) float32 measured ends, world frame, metres.
        origin: (3,) float32 origin of the rays.
        resolution_m: Voxel edge.
        max_range_m: A longer ray only frees space, up to this range.

    Returns:
        (N, 3) float32 stops; (N,) bool, true for rays with an occupied end; (3,) int64 smallest and (3,)
        int64 largest key that stepping along the rays can reach; number of ends that have no key.
    """
    inverse_resolution = 1.0 / resolution_m
    stops = np.empty_like(ends)
    hits = np.empty(len(ends), np.bool_)
    lowest, highest = origin.copy(), origin.copy()
    outside = 0
    for i in range(len(ends)):
        x, y, z = ends[i, 0], ends[i, 1], ends[i, 2]
        for axis in range(3):
            key = np.floor(inverse_resolution * float64(ends[i, axis])) + KEY_ZERO
            if not (key >= 0 and key < KEY_COUNT):
                outside += 1
                break
        dx, dy, dz = x - origin[0], y - origin[1], z - origin[2]
        length = sqrt(float64(dx * dx + dy * dy + dz * dz))
        hits[i] = length <= max_range_m
        if not hits[i]:
            x = origin[0] + dx / float32(length) * float32(max_range_m)
            y = origin[1] + dy / float32(length) * float32(max_range_m)
            z = origin[2] + dz / float32(length) * float32(max_range_m)
        stops[i, 0], stops[i, 1], stops[i, 2] = x, y, z
        lowest[0], lowest[1], lowest[2] = min(lowest[0], x), min(lowest[1], y), min(lowest[2], z)
        highest[0], highest[1], highest[2] = max(highest[0], x), max(highest[1], y), max(highest[2], z)
    low_key, high_key = np.empty(3, int64), np.empty(3, int64)
    for axis in range(3):
        # A ray that ends on a voxel's border may step one voxel too far before its length is checked.
        low_key[axis] = key_of(lowest[axis], inverse_resolution) - 1
        high_key[axis] = key_of(highest[axis], inverse_resolution) + 1
    return stops, hits, low_key, high_key, outside


@njit(cache=True, nogil=True, error_model="numpy")
def cast_rays(stops, hits, origin, resolution_m, window):
    """Rasterise rays into a window: FREE along them, then OCCUPIED at their ends (Amanatides & Woo 1987).

    A ray does not free the voxel where it stops. Where it meets two borders at once the later axis steps.

    Args:
        stops: (N, 3) float32 stops of the rays, world frame, metres.
        hits: (N,) bool, true where the stop is an obstacle.
        origin: (3,) float32 origin of the rays.
        resolution_m: Voxel edge.
        window: Window around the rays.
    """
    inverse_resolution = 1.0 / resolution_m
    cells, touched = window.cells, window.touched
    x_bits, y_bits, z_bits = window.bits[0], window.bits[1], window.bits[2]
    key_x = key_of(origin[0], inverse_resolution)
    key_y = key_of(origin[1], inverse_resolution)
    key_z = key_of(origin[2], inverse_resolution)
    first = cell_of(window, key_x, key_y, key_z)
    for i in range(len(stops)):
        last = _stop_cell(window, stops, i, inverse_resolution)
        if last == first:
            continue
        dx, dy, dz = stops[i, 0] - origin[0], stops[i, 1] - origin[1], stops[i, 2] - origin[2]
        length = float32(sqrt(float64(dx * dx + dy * dy + dz * dz)))
        x_step, x_time, x_delta = _axis(dx / length, origin[0], key_x, x_bits, resolution_m)
        y_step, y_time, y_delta = _axis(dy / length, origin[1], key_y, y_bits, resolution_m)
        z_step, z_time, z_delta = _axis(dz / length, origin[2], key_z, z_bits, resolution_m)
        x, y, z = first & x_bits, first & y_bits, first & z_bits
        cell = first
        reach = float64(length)
        while True:
            cells[cell] = FREE
            touched[cell >> (3 * BLOCK_BITS)] = 1
            if x_time < y_time:  # nested: joining this test and the next takes 5 % more time
                if x_time < z_time:
                    x = (x + x_step) & x_bits
                    x_time += x_delta
                else:
                    z = (z + z_step) & z_bits
                    z_time += z_delta
            elif y_time < z_time:
                y = (y + y_step) & y_bits
                y_time += y_delta
            else:
                z = (z + z_step) & z_bits
                z_time += z_delta
            cell = x | y | z
            if cell == last or (x_time > reach and y_time > reach and z_time > reach):
                break
    for i in range(len(stops)):
        if hits[i]:
            cell = _stop_cell(window, stops, i, inverse_resolution)
            cells[cell] = OCCUPIED
            touched[cell >> (3 * BLOCK_BITS)] = 1


@njit(cache=True, nogil=True)
def _stop_cell(window, stops, i, inverse_resolution):
    x = key_of(stops[i, 0], inverse_resolution)
    y = key_of(stops[i, 1], inverse_resolution)
    z = key_of(stops[i, 2], inverse_resolution)
    return cell_of(window, x, y, z)


@njit(cache=True, nogil=True, error_model="numpy")
def _axis(direction, origin, key, bits, resolution_m):
    """Return the increment of an axis's bits by a step, and the lengths to the first and between borders."""
    if direction == 0:
        return int64(0), _NEVER, _NEVER
    # Subtracting the mask adds one in the masked bits: the carry runs through all the others.
    step = -bits if direction > 0 else int64(-1)
    half = float64(float32(resolution_m * 0.5))
    border = centre_of(key, resolution_m) + (half if direction > 0 else -half)
    time = (border - float64(origin)) / float64(direction)
    return step, time, resolution_m / abs(float64(direction))


@njit(cache=True, nogil=True)
def merge(cells, positions, slots, values, sensor):
    """Update the map's log-odds by a rasterised scan, and reset the scan's cells to UNTOUCHED.

    Args:
        cells: (C,) uint8 cells of the window with the scan.
        positions: (B,) int64 positions of the touched blocks in the window.
        slots: (B,) int64 rows of the same blocks in ``values``.
        values: (capacity, 512) float32 log-odds; NaN is unknown.
        sensor: Increments and clamps.

    Returns:
        Number of voxels that became known.
    """
    hit, miss, lowest, highest = sensor.hit, sensor.miss, sensor.lowest, sensor.highest
    added = 0
    for i in range(len(positions)):
        start = positions[i] * BLOCK_VOXELS
        seen_block = cells[start : start + BLOCK_VOXELS]
        block = values[slots[i]]
        block_added = int32(0)
        for j in range(BLOCK_VOXELS):  # this loop vectorises: selections only, no branch
            seen = int32(seen_block[j])
            old = block[j]
            unknown = old != old
            value = float32(0.0) if unknown else old
            new = value + (hit if seen == OCCUPIED else miss)
            new = lowest if new < lowest else new
            new = highest if new > highest else new
            # OctoMap does not change a voxel at or beyond the clamp, as one from a file may be.
            clamped = value >= highest if seen == OCCUPIED else value <= lowest
            new = value if clamped else new
            block[j] = old if seen == UNTOUCHED else new
            block_added += int32(unknown & (seen != UNTOUCHED))
        added += block_added
        seen_block[:] = UNTOUCHED
    return added
