"""Voxel attributes where rays ended: mean colour, hit count, time of the last hit.

A layer of its own, for those blocks only that have such a voxel: 14 KiB each, in addition to 2 KiB of
log-odds. Sums are whole numbers, so colours do not depend on the order of scans.
"""

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy import float32, float64, int64, uint32
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Array, Points, Transform
from mapper.octree.config import OctreeConfig
from mapper.octree.keys import (
    BLOCK_BITS,
    BLOCK_VOXELS,
    KEY_BITS,
    KEY_MASK,
    centre_of,
    codes_of,
    key_of,
    morton,
)
from mapper.octree.ray_casting_kernels import OCCUPIED
from mapper.octree.sparse_grid import FIRST_BLOCKS, GROWTH, BlockStore, check_memory, find_slots, slot_of

NEVER_SEEN = int(np.iinfo(np.int64).min)
"""``last_seen_ns`` of a voxel where no stamped ray has ended."""
UNSET = 255
"""Each channel of OctoMap's colour for "none": white."""

_VOXEL_BYTES = 3 * 4 + 4 + 4 + 8
_FULL_WEIGHT = 1 << 24  # 255 times as much still fits into 32 bits


class LayerArrays(NamedTuple):
    """The arrays of a layer, for compiled code.

    Attributes:
        rows: (S,) int32 row of each of the map's blocks, by slot; −1 has none.
        color_sums: (R, 512, 3) uint32 sums of RGB.
        color_weights: (R, 512) uint32 number of measurements in the sums. At 2²⁴ both are halved.
        hits: (R, 512) uint32 number of measurements that ended in a voxel, coloured or not.
        last_seen_ns: (R, 512) int64 latest stamp of those.
    """

    rows: NDArray[np.int32]
    color_sums: NDArray[np.uint32]
    color_weights: NDArray[np.uint32]
    hits: NDArray[np.uint32]
    last_seen_ns: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class VoxelAttributes:
    """Attributes of N voxels.

    Attributes:
        colors: (N, 3) uint8 mean RGB, rounded; white where there is none.
        colored: (N,) bool.
        hits: (N,) uint32 number of measurements that ended there.
        last_seen_ns: (N,) int64 stamp of the latest scan that ended there, ``NEVER_SEEN`` where none did.
    """

    colors: NDArray[np.uint8]
    colored: NDArray[np.bool_]
    hits: NDArray[np.uint32]
    last_seen_ns: NDArray[np.int64]


class AttributeLayer:
    """Attributes of the voxels of one map, stored by block."""

    def __init__(self, blocks: BlockStore, resolution_m: float) -> None:
        self._blocks = blocks
        self._resolution_m = resolution_m
        self._count = 0
        self._arrays = _grow(None, slots=0, rows=FIRST_BLOCKS)

    @property
    def memory_bytes(self) -> int:
        """Bytes held, spare capacity included."""
        return sum(array.nbytes for array in self._arrays)

    @property
    def has_colors(self) -> bool:
        """Whether any voxel has a colour."""
        return bool(self._arrays.color_weights[: self._count].any())

    @property
    def slots(self) -> NDArray[np.int64]:
        """(R,) slots of the blocks that have attributes, in Morton order."""
        held = np.flatnonzero(self._arrays.rows >= 0)
        return held[np.argsort(self._blocks.codes[held])]

    @property
    def arrays(self) -> LayerArrays:
        """The layer for compiled code; valid until the next claim."""
        return self._arrays

    def claim(self, slots: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return the rows of blocks; blocks without one get an empty row.

        Raises:
            MapSizeError: The layer would not fit into this machine's memory; nothing has changed then.
        """
        capacity = len(self._arrays.rows)
        if len(self._blocks) > capacity:
            spare = np.full(len(self._blocks) - capacity, -1, np.int32)
            self._arrays = self._arrays._replace(rows=np.append(self._arrays.rows, spare))
        missing = slots[self._arrays.rows[slots] < 0]
        count = self._count + len(missing)
        if count > len(self._arrays.hits):
            check_memory(count * BLOCK_VOXELS * _VOXEL_BYTES, f"attributes of {count} blocks of 8³ voxels")
            rows = max(count, int(len(self._arrays.hits) * GROWTH))
            self._arrays = _grow(self._arrays, slots=len(self._arrays.rows), rows=rows)
        self._arrays.rows[missing] = np.arange(self._count, count)
        self._count = count
        return self._arrays.rows[slots]

    def add(
        self,
        points_body: Points32,
        T_world_body: Transform,
        *,
        origin_world: Array,
        config: OctreeConfig,
        colors: NDArray[np.uint8] | None,
        stamp_ns: int,
    ) -> None:
        """Add the ends of a scan's rays; their blocks must have been claimed.

        Args:
            points_body: (N, 3) float32 metres.
            T_world_body: (4, 4).
            origin_world: (3,) float32 where the rays start.
            config: Rays longer than its range have no end; if it discretizes, a ray's length is that to the
                centre of its end voxel.
            colors: (N, 3) uint8 RGB.
            stamp_ns: Stamp of the scan.
        """
        _add(
            np.ascontiguousarray(points_body, dtype=np.float32),
            np.empty((0, 3), np.uint8) if colors is None else np.ascontiguousarray(colors),
            np.ascontiguousarray(T_world_body),
            np.asarray(origin_world, dtype=np.float32),
            self._resolution_m,
            config.range_limit_m,
            config.discretize,
            stamp_ns,
            self._blocks.table,
            self._arrays,
        )

    def add_layer(self, other: "AttributeLayer", slots: NDArray[np.int64], own: NDArray[np.int64]) -> None:
        """Add another map's attributes of the same voxels.

        Args:
            other: The other map's layer.
            slots: (B,) slots of the other map's blocks.
            own: (B,) slots of the same blocks in this map.

        Raises:
            MapSizeError: The layer would not fit into this machine's memory; nothing has changed then.
        """
        rows = other.arrays.rows
        held = slots < len(rows)
        held[held] = rows[slots[held]] >= 0
        _add_rows(self.claim(own[held]), self._arrays, rows[slots[held]], other.arrays)

    def clear_unknown(self) -> None:
        """Remove the attributes of voxels that have become unknown."""
        slots = self.slots
        which, voxels = np.nonzero(np.isnan(self._blocks.table.values[slots]))
        index = self._arrays.rows[slots][which], voxels
        self._arrays.color_sums[index] = 0
        self._arrays.color_weights[index] = 0
        self._arrays.hits[index] = 0
        self._arrays.last_seen_ns[index] = NEVER_SEEN

    def renumber(self, kept: NDArray[np.int64]) -> None:
        """Follow the map's blocks to the slots 0 … K − 1, given the (K,) slots that they had."""
        rows = np.append(self._arrays.rows, np.full(kept.max(initial=-1) + 1, -1, np.int32))[kept]
        self._arrays = self._arrays._replace(rows=rows)

    def block_colors(self, slots: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Return the (B, 512, 3) uint8 mean RGB of blocks with attributes, white where there is none."""
        rows = np.repeat(self._arrays.rows[slots], BLOCK_VOXELS)
        voxels = np.tile(np.arange(BLOCK_VOXELS), len(slots))
        return self._gather(rows, voxels).colors.reshape(-1, BLOCK_VOXELS, 3)

    def restore_colors(
        self, codes: NDArray[np.int64], depths: NDArray[np.uint8], colors: NDArray[np.uint8]
    ) -> None:
        """Take over the (L, 3) colours of a file's leaves, each as one measurement; white is none.

        Args:
            codes: (L,) Morton codes of the leaves' first voxels, all known to the map.
            depths: (L,) of the leaves, 16 for a single voxel.
            colors: (L, 3) uint8 RGB.
        """
        coloured = (colors != UNSET).any(axis=1)
        codes, depths, colors = codes[coloured], depths[coloured], colors[coloured]
        counts = np.int64(1) << (3 * (KEY_BITS - depths.astype(np.int64)))
        leaf = np.repeat(np.arange(len(codes)), counts)
        voxels = codes[leaf] + np.arange(len(leaf)) - (np.cumsum(counts) - counts)[leaf]
        blocks, which = np.unique(voxels >> (3 * BLOCK_BITS), return_inverse=True)
        slots = np.empty(len(blocks), np.int64)
        find_slots(self._blocks.table, blocks, slots)
        index = self.claim(slots)[which], voxels & (BLOCK_VOXELS - 1)
        self._arrays.color_sums[index] = colors[leaf]
        self._arrays.color_weights[index] = 1

    def at(self, points_world: Points) -> VoxelAttributes:
        """Return the attributes of the N voxels around (N, 3) points, metres; none outside the map."""
        points = np.ascontiguousarray(points_world, dtype=np.float64)
        return self._gather(
            *_rows_and_voxels(self._blocks.table, self._arrays.rows, codes_of(points, self._resolution_m))
        )

    def _gather(self, rows: NDArray[np.int32], voxels: NDArray[np.int64]) -> VoxelAttributes:
        absent = rows < 0
        weights = self._arrays.color_weights[rows, voxels]
        hits = self._arrays.hits[rows, voxels]
        last_seen_ns = self._arrays.last_seen_ns[rows, voxels]
        weights[absent], hits[absent], last_seen_ns[absent] = 0, 0, NEVER_SEEN
        colors = _means(self._arrays.color_sums, weights, rows, voxels)
        return VoxelAttributes(colors, weights > 0, hits, last_seen_ns)


def _grow(old: LayerArrays | None, *, slots: int, rows: int) -> LayerArrays:
    """Return a layer of a larger size that begins with the old one."""
    new = LayerArrays(
        np.full(slots, -1, np.int32),
        np.zeros((rows, BLOCK_VOXELS, 3), np.uint32),
        np.zeros((rows, BLOCK_VOXELS), np.uint32),
        np.zeros((rows, BLOCK_VOXELS), np.uint32),
        np.full((rows, BLOCK_VOXELS), NEVER_SEEN, np.int64),
    )
    if old is not None:
        for name in LayerArrays._fields:
            before = getattr(old, name)
            getattr(new, name)[: len(before)] = before
    return new


@njit(cache=True, nogil=True)
def _add(
    points_body,
    colors,
    T_world_body,
    origin,
    resolution_m,
    max_range_m,
    discretize,
    stamp_ns,
    table,
    layer,
):
    """Add the end of every ray that has an occupied one, by the arithmetic of ``kernels.clip_rays``.

    Neighbouring pixels mostly share a voxel, so sums go to the layer when the voxel changes.
    """
    inverse_resolution = 1.0 / resolution_m
    T = T_world_body
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    origin_x, origin_y, origin_z = origin[0], origin[1], origin[2]
    colored = len(colors) > 0
    here, reached = int64(-1), False
    count, red, green, blue = int64(0), int64(0), int64(0), int64(0)
    for i in range(len(points_body)):
        bx, by, bz = float64(points_body[i, 0]), float64(points_body[i, 1]), float64(points_body[i, 2])
        x = float32(r00 * bx + r01 * by + r02 * bz + t0)
        y = float32(r10 * bx + r11 * by + r12 * bz + t1)
        z = float32(r20 * bx + r21 * by + r22 * bz + t2)
        key_x = key_of(x, inverse_resolution)
        key_y = key_of(y, inverse_resolution)
        key_z = key_of(z, inverse_resolution)
        packed = key_x | (key_y << KEY_BITS) | (key_z << (2 * KEY_BITS))
        moved = packed != here
        if moved:
            if count:
                _flush(table, layer, here, stamp_ns, count, colored, red, green, blue)
            here, count, red, green, blue = packed, 0, 0, 0, 0
        if moved or not discretize:
            if discretize:
                x = float32(centre_of(key_x, resolution_m))
                y = float32(centre_of(key_y, resolution_m))
                z = float32(centre_of(key_z, resolution_m))
            dx, dy, dz = x - origin_x, y - origin_y, z - origin_z
            reached = sqrt(float64(dx * dx + dy * dy + dz * dz)) <= max_range_m
        if reached:
            count += 1
            if colored:
                red += colors[i, 0]
                green += colors[i, 1]
                blue += colors[i, 2]
    if count:
        _flush(table, layer, here, stamp_ns, count, colored, red, green, blue)


@njit(cache=True, nogil=True)
def _flush(table, layer, packed, stamp_ns, count, colored, red, green, blue):
    """Add the sums of ``count`` measurements to the voxel of three packed keys."""
    code = morton(packed & KEY_MASK, (packed >> KEY_BITS) & KEY_MASK, packed >> (2 * KEY_BITS))
    row, voxel = layer.rows[slot_of(table, code >> (3 * BLOCK_BITS))], code & (BLOCK_VOXELS - 1)
    layer.hits[row, voxel] += uint32(count)
    layer.last_seen_ns[row, voxel] = max(layer.last_seen_ns[row, voxel], stamp_ns)
    if colored:
        while layer.color_weights[row, voxel] + count > _FULL_WEIGHT:
            layer.color_weights[row, voxel] >>= uint32(1)
            for channel in range(3):
                layer.color_sums[row, voxel, channel] >>= uint32(1)
        layer.color_weights[row, voxel] += uint32(count)
        layer.color_sums[row, voxel, 0] += uint32(red)
        layer.color_sums[row, voxel, 1] += uint32(green)
        layer.color_sums[row, voxel, 2] += uint32(blue)


@njit(cache=True, nogil=True)
def _add_rows(own_rows, own, rows, other):
    """Add attributes block by block; a colour's weight stays at or below the full one."""
    for b in range(len(rows)):
        into, row = own_rows[b], rows[b]
        for voxel in range(BLOCK_VOXELS):
            own.hits[into, voxel] += other.hits[row, voxel]
            own.last_seen_ns[into, voxel] = max(own.last_seen_ns[into, voxel], other.last_seen_ns[row, voxel])
            weight = int64(own.color_weights[into, voxel]) + int64(other.color_weights[row, voxel])
            shift = int64(weight > _FULL_WEIGHT)
            own.color_weights[into, voxel] = uint32(weight >> shift)
            for channel in range(3):
                total = int64(own.color_sums[into, voxel, channel]) + other.color_sums[row, voxel, channel]
                own.color_sums[into, voxel, channel] = uint32(total >> shift)


@njit(cache=True, nogil=True)
def ended_blocks(cells, positions):
    """Return the (B,) mask of the blocks of a window that hold an occupied cell."""
    ended = np.empty(len(positions), np.bool_)
    for i in range(len(positions)):
        highest = np.uint8(0)
        for cell in cells[positions[i] * BLOCK_VOXELS : (positions[i] + 1) * BLOCK_VOXELS]:
            highest = max(highest, cell)
        ended[i] = highest == OCCUPIED
    return ended


@njit(cache=True, nogil=True)
def _rows_and_voxels(table, rows, codes):
    """Return (N,) rows of voxels' blocks, −1 without attributes, and (N,) their numbers in the blocks."""
    found, voxels = np.full(len(codes), -1, np.int32), np.empty(len(codes), int64)
    for i in range(len(codes)):
        voxels[i] = codes[i] & (BLOCK_VOXELS - 1)
        if codes[i] >= 0:
            slot = slot_of(table, codes[i] >> (3 * BLOCK_BITS))
            if slot >= 0 and slot < len(rows):
                found[i] = rows[slot]
    return found, voxels


@njit(cache=True, nogil=True)
def _means(color_sums, weights, rows, voxels):
    """Return (N, 3) uint8 sums over weights, half rounded up; white where the weight is 0."""
    colors = np.full((len(weights), 3), UNSET, np.uint8)
    for i in range(len(weights)):
        weight = int64(weights[i])
        if weight:
            for channel in range(3):
                colors[i, channel] = (2 * int64(color_sums[rows[i], voxels[i], channel]) + weight) // (
                    2 * weight
                )
    return colors
