"""Compiled steps from a scan's points to updated log-odds, equal to OctoMap's to the last bit.

OctoMap (Hornung et al. 2013, release 1.10) computes in a mixture of float32 and float64. The casts below
repeat that mixture; without ``fastmath`` the compiler neither fuses nor reorders them.

A scan is first rasterised into a dense window: a ray loop that looks every voxel up in a hash table is slow.
In the window a voxel's cell is the union of three masked integers, and a step along an axis adds one number
to one of them. The window wraps around at powers of two, so scans may lie anywhere. Cells are in Morton order
while all axes have bits left; the lowest nine bits number the voxels of a block.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy import float32, float64, int32, int64
from numpy.typing import NDArray

from mapper.core.voxel_index import FIBONACCI
from mapper.octree.keys import (
    BLOCK_BITS,
    BLOCK_VOXELS,
    KEY_BITS,
    KEY_COUNT,
    KEY_MASK,
    KEY_ZERO,
    centre_of,
    have_keys,
    key_of,
    morton,
)

UNTOUCHED, FREE, OCCUPIED = range(3)
"""States of a cell after a scan, ordered so that occupied wins."""

CHUNK = 256  # points worked on at a time: their scratch arrays stay in the first-level cache
_RECENT = 1 << 15  # entries of the table of recent voxels: 256 KiB
_RAYS = 16  # rays that step together: two vectors of eight float64
_STEPS = 8  # steps before ended rays are looked for
NEVER = float64(np.finfo(np.float64).max)
"""OctoMap's tMax along an axis that the ray does not move on."""

_T_MAX, _T_DELTA, _T_END = (_RAYS * row for row in (0, 3, 6))
_CELL, _STEP, _END = _T_MAX, _T_DELTA, _T_END
_GOES_ON, _Y, _Z = _END + _RAYS, _RAYS, _RAYS + _RAYS
"""Rows of the two arrays of ``_step_along``: a quantity's first row is that of x; y and z follow."""


class Window(NamedTuple):
    """The arrays of a window around one scan.

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


@njit(cache=True, nogil=True)
def cell_of(window, x, y, z):
    """Return the cell of three keys."""
    return (
        window.cell_bits[0, (x - window.base[0]) & window.wrap[0]]
        | window.cell_bits[1, (y - window.base[1]) & window.wrap[1]]
        | window.cell_bits[2, (z - window.base[2]) & window.wrap[2]]
    )


@njit(cache=True, nogil=True)
def block_codes(window, positions, lowest):
    """Return the (B,) Morton codes of blocks.

    Args:
        window: The window with the blocks.
        positions: (B,) int64 positions of the blocks in it.
        lowest: (3,) int64 smallest keys of the window, which resolve the wrap-around.
    """
    codes = np.empty(len(positions), np.int64)
    key = np.empty(3, np.int64)
    for i in range(len(positions)):
        packed = 0
        for byte in range(4):
            packed += window.offsets[byte, (positions[i] >> (8 * byte)) & 0xFF]
        for axis in range(3):
            first = lowest[axis] >> BLOCK_BITS
            beyond = (window.base[axis] >> BLOCK_BITS) + ((packed >> (KEY_BITS * axis)) & KEY_MASK) - first
            key[axis] = (first + (beyond & (window.wrap[axis] >> BLOCK_BITS))) & (KEY_MASK >> BLOCK_BITS)
        codes[i] = morton(key[0], key[1], key[2])
    return codes


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
    x, y, z = np.empty(CHUNK, float32), np.empty(CHUNK, float32), np.empty(CHUNK, float32)
    packed, runs = np.empty(CHUNK + 1, int64), np.empty(CHUNK + 1, int64)
    recent = np.full(_RECENT, -1, int64)
    found = np.empty(n + 1, int64)
    count, outside = 0, 0
    r00, r01, r02, t0 = T_world_body[0, 0], T_world_body[0, 1], T_world_body[0, 2], T_world_body[0, 3]
    r10, r11, r12, t1 = T_world_body[1, 0], T_world_body[1, 1], T_world_body[1, 2], T_world_body[1, 3]
    r20, r21, r22, t2 = T_world_body[2, 0], T_world_body[2, 1], T_world_body[2, 2], T_world_body[2, 3]
    packed[0] = -1
    for start in range(0, n, CHUNK):
        size = min(CHUNK, n - start)
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
    cells, touched, bits = window.cells, window.touched, window.bits
    keys, borders = np.empty(3, int64), np.empty((3, 2), float64)
    half = float64(float32(resolution_m * 0.5))
    for axis in range(3):
        keys[axis] = key_of(origin[axis], inverse_resolution)
        centre = centre_of(keys[axis], resolution_m)
        borders[axis, 0] = centre - half - float64(origin[axis])
        borders[axis, 1] = centre + half - float64(origin[axis])
    first = cell_of(window, keys[0], keys[1], keys[2])
    ends = np.empty(len(stops), int64)
    rays = np.ones(3 * _RAYS, float32)
    norms = np.empty(_RAYS, float32)
    t, at = np.empty(7 * _RAYS, float64), np.zeros(8 * _RAYS, int64)
    path = np.empty(_STEPS * _RAYS, int64)
    for start in range(0, len(stops), _RAYS):
        size = min(_RAYS, len(stops) - start)
        for j in range(size):
            for axis in range(3):
                rays[axis * _RAYS + j] = stops[start + j, axis] - origin[axis]
        _measure(rays, norms, t)
        # Each axis by a call of its own: with known rows the loop within vectorises.
        _initialise(0, rays, norms, borders[0], first, bits[0], resolution_m, t, at)
        _initialise(1, rays, norms, borders[1], first, bits[1], resolution_m, t, at)
        _initialise(2, rays, norms, borders[2], first, bits[2], resolution_m, t, at)
        going = 0
        for j in range(_RAYS):
            at[_GOES_ON + j] = 0
        for j in range(size):
            x = key_of(stops[start + j, 0], inverse_resolution)
            y = key_of(stops[start + j, 1], inverse_resolution)
            z = key_of(stops[start + j, 2], inverse_resolution)
            end = cell_of(window, x, y, z)
            ends[start + j] = at[_END + j] = end
            at[_GOES_ON + j] = end != first
            going += end != first
        while going:
            going = _step_along(t, at, path, first, bits[0], bits[1], bits[2])
            for j in range(_STEPS * _RAYS):
                cell = path[j]
                cells[cell] = FREE
                touched[cell >> (3 * BLOCK_BITS)] = 1
    for i in range(len(stops)):
        if hits[i]:
            cell = ends[i]
            cells[cell] = OCCUPIED
            touched[cell >> (3 * BLOCK_BITS)] = 1


@njit(cache=True, nogil=True, error_model="numpy")
def _measure(rays, norms, t):
    """Write the lengths of rays in both precisions: (R,) float32, and the row t_end."""
    for j in range(_RAYS):
        x, y, z = rays[j], rays[_Y + j], rays[_Z + j]
        norm = float32(sqrt(float64(x * x + y * y + z * z)))
        norms[j] = norm
        t[_T_END + j] = float64(norm)


@njit(cache=True, nogil=True, error_model="numpy")
def _initialise(axis, rays, norms, borders, first, bits, resolution_m, t, at):
    """Write tMax, tDelta, step and cell of one axis as they are where the rays begin.

    Args:
        axis: 0, 1 or 2.
        rays: (3 · R,) float32 rows x, y, z from the origin to the stops.
        norms: (R,) float32 their lengths.
        borders: (2,) float64 where the lower and the higher border of the origin's voxel are.
        first: Cell of the origin.
        bits: Mask of the axis's bits in a cell's index.
        resolution_m: Voxel edge.
        t: As in ``_step_along``.
        at: As in ``_step_along``.
    """
    behind, ahead = borders[0], borders[1]
    for j in range(_RAYS):
        direction = float64(rays[axis * _RAYS + j] / norms[j])
        moves = direction != 0.0
        t_max = (ahead if direction > 0.0 else behind) / direction
        t_delta = resolution_m / abs(direction)
        t[_T_MAX + axis * _RAYS + j] = t_max if moves else NEVER
        t[_T_DELTA + axis * _RAYS + j] = t_delta if moves else NEVER
        # Subtracting the mask adds one in the masked bits: the carry runs through all the others.
        step = -bits if direction > 0.0 else int64(-1)
        at[_STEP + axis * _RAYS + j] = step if moves else int64(0)
        at[_CELL + axis * _RAYS + j] = first & bits


@njit(cache=True, nogil=True, error_model="numpy")
def _step_along(t, at, path, first, x_bits, y_bits, z_bits):
    """Take some steps along every ray, and return how many rays have not ended then.

    The inner loop vectorises: all its rows are at constant distances in two arrays, and it has no branch.

    Args:
        t: (7 · R,) float64 rows of lengths along the ray: tMax along x, y, z; tDelta along x, y, z; its end.
        at: (8 · R,) int64 rows: bits of the cell along x, y, z; step along x, y, z; the last cell; 1 while
            the ray goes on.
        path: (S · R,) int64 result: the cells in which the steps begin; ``first`` where a ray has ended.
        first: Cell of the origin.
        x_bits: Mask of the bits of a cell's index along x.
        y_bits: Mask of those along y.
        z_bits: Mask of those along z.
    """
    for n in range(_STEPS):
        for j in range(_RAYS):
            x, y, z = at[_CELL + j], at[_CELL + _Y + j], at[_CELL + _Z + j]
            t_max_x, t_max_y, t_max_z = t[_T_MAX + j], t[_T_MAX + _Y + j], t[_T_MAX + _Z + j]
            goes_on = at[_GOES_ON + j]
            path[n * _RAYS + j] = x | y | z if goes_on != 0 else first
            along_x = (t_max_x < t_max_y) & (t_max_x < t_max_z)
            along_y = (not t_max_x < t_max_y) & (t_max_y < t_max_z)
            along_z = not (along_x | along_y)
            next_x = (x + at[_STEP + j]) & x_bits
            next_y = (y + at[_STEP + _Y + j]) & y_bits
            next_z = (z + at[_STEP + _Z + j]) & z_bits
            x = next_x if along_x else x
            y = next_y if along_y else y
            z = next_z if along_z else z
            t_next_x = t_max_x + t[_T_DELTA + j]
            t_next_y = t_max_y + t[_T_DELTA + _Y + j]
            t_next_z = t_max_z + t[_T_DELTA + _Z + j]
            t_max_x = t_next_x if along_x else t_max_x
            t_max_y = t_next_y if along_y else t_max_y
            t_max_z = t_next_z if along_z else t_max_z
            at[_CELL + j], at[_CELL + _Y + j], at[_CELL + _Z + j] = x, y, z
            t[_T_MAX + j], t[_T_MAX + _Y + j], t[_T_MAX + _Z + j] = t_max_x, t_max_y, t_max_z
            t_end = t[_T_END + j]
            is_beyond = (t_max_x > t_end) & (t_max_y > t_end) & (t_max_z > t_end)
            has_ended = ((x | y | z) == at[_END + j]) | is_beyond
            at[_GOES_ON + j] = int64(0) if has_ended else goes_on
    going = int64(0)
    for j in range(_RAYS):
        going += at[_GOES_ON + j]
    return going


@njit(cache=True, nogil=True)
def merge(cells, positions, slots, values, sensor):
    """Update the map's log-odds by a rasterised scan, and reset the scan's cells to UNTOUCHED.

    Args:
        cells: (C,) uint8 cells of the window with the scan.
        positions: (B,) int64 positions of the touched blocks in the window.
        slots: (B,) int64 rows of the same blocks in ``values``.
        values: (capacity, 512) float32 log-odds; NaN is unknown.
        sensor: Increments and clamps.
    """
    hit, miss, lowest, highest = sensor.hit, sensor.miss, sensor.lowest, sensor.highest
    for i in range(len(positions)):
        start = positions[i] * BLOCK_VOXELS
        seen_block = cells[start : start + BLOCK_VOXELS]
        block = values[slots[i]]
        for j in range(BLOCK_VOXELS):  # this loop vectorises: selections only, no branch
            seen = int32(seen_block[j])
            old = block[j]
            value = float32(0.0) if old != old else old
            new = value + (hit if seen == OCCUPIED else miss)
            new = lowest if new < lowest else new
            new = highest if new > highest else new
            # OctoMap does not change a voxel at or beyond the clamp, as one from a file may be.
            clamped = value >= highest if seen == OCCUPIED else value <= lowest
            new = value if clamped else new
            block[j] = old if seen == UNTOUCHED else new
        seen_block[:] = UNTOUCHED
