"""Counts of occupied, free and unknown voxels in axis-aligned boxes."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy import int64
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Points
from mapper.octree.blocks import BlockStore, slot_of
from mapper.octree.keys import BLOCK_BITS, KEY_ZERO, gather, morton

_EDGE = 1 << BLOCK_BITS
_ROUNDING = 1e-6
"""Share of a voxel; keeps rounding from adding a layer where a face lies on a voxel's border."""


@dataclass(frozen=True, slots=True, eq=False)
class BoxCounts:
    """Number of voxels of each state that N boxes overlap.

    Attributes:
        occupied: (N,) int64.
        free: (N,) int64.
        unknown: (N,) int64; space that no key reaches is left out.
    """

    occupied: NDArray[np.int64]
    free: NDArray[np.int64]
    unknown: NDArray[np.int64]

    @property
    def any_occupied(self) -> NDArray[np.bool_]:
        """(N,) bool, true where a box overlaps an occupied voxel."""
        return self.occupied > 0

    @property
    def all_free(self) -> NDArray[np.bool_]:
        """(N,) bool, true where a box overlaps free voxels only."""
        found: NDArray[np.bool_] = (self.free > 0) & (self.occupied == 0) & (self.unknown == 0)
        return found


def count_boxes(
    store: BlockStore, lower_world: Points, upper_world: Points, *, resolution_m: float, threshold: np.float32
) -> BoxCounts:
    """Count the voxels that boxes overlap; a box that is a point overlaps the voxel around it.

    The time grows with the number of voxels in a box, up to the number in the map.

    Args:
        store: The voxels.
        lower_world: (N, 3) metres.
        upper_world: (N, 3) metres.
        resolution_m: Edge of a voxel.
        threshold: Log-odds from which a voxel is occupied.

    Raises:
        DataError: Shapes differ, or corners are not finite or in the wrong order.
    """
    lower, upper = np.asarray(lower_world, np.float64), np.asarray(upper_world, np.float64)
    if lower.shape != upper.shape or lower.ndim != 2 or lower.shape[1] != 3:
        raise DataError(f"octree: boxes from {lower.shape} to {upper.shape}, want two (N, 3)")
    if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (lower <= upper).all()):
        raise DataError("octree: every box needs finite corners, the lower one first")
    first = np.floor(lower / resolution_m + _ROUNDING)
    last = np.maximum(np.ceil(upper / resolution_m - _ROUNDING) - 1.0, first)
    reach = -KEY_ZERO, KEY_ZERO - 1
    outside = ((last < reach[0]) | (first > reach[1])).any(axis=1)
    first_key, last_key = (np.clip(keys, *reach).astype(np.int64) + KEY_ZERO for keys in (first, last))
    last_key[outside] = first_key[outside] - 1
    counts = _count(store.table, store.codes, first_key, last_key, threshold)
    volume = np.prod(last_key - first_key + 1, axis=1)
    return BoxCounts(counts[:, 0], counts[:, 1], volume - counts.sum(axis=1))


@njit(cache=True, nogil=True)
def _count(table, codes, first, last, threshold):
    """Return (N, 2) int64 occupied and free voxels between inclusive keys."""
    counts = np.zeros((len(first), 2), int64)
    for i in range(len(first)):
        blocks = 1
        for axis in range(3):
            blocks *= max((last[i, axis] >> BLOCK_BITS) - (first[i, axis] >> BLOCK_BITS) + 1, 0)
        if blocks > len(codes):
            for slot in range(len(codes)):
                x, y, z = gather(codes[slot]), gather(codes[slot] >> 1), gather(codes[slot] >> 2)
                _count_block(table.values[slot], x, y, z, first[i], last[i], threshold, counts[i])
            continue
        for z in range(first[i, 2] >> BLOCK_BITS, (last[i, 2] >> BLOCK_BITS) + 1):
            for y in range(first[i, 1] >> BLOCK_BITS, (last[i, 1] >> BLOCK_BITS) + 1):
                for x in range(first[i, 0] >> BLOCK_BITS, (last[i, 0] >> BLOCK_BITS) + 1):
                    slot = slot_of(table, morton(x, y, z))
                    if slot >= 0:
                        _count_block(table.values[slot], x, y, z, first[i], last[i], threshold, counts[i])
    return counts


@njit(cache=True, nogil=True)
def _count_block(block, x, y, z, first, last, threshold, counts):
    """Add a block's voxels between inclusive keys to ``counts``; x, y, z are the block's keys >> 3."""
    for k in range(max(first[2] - z * _EDGE, 0), min(last[2] - z * _EDGE, _EDGE - 1) + 1):
        for j in range(max(first[1] - y * _EDGE, 0), min(last[1] - y * _EDGE, _EDGE - 1) + 1):
            for i in range(max(first[0] - x * _EDGE, 0), min(last[0] - x * _EDGE, _EDGE - 1) + 1):
                value = block[morton(i, j, k)]
                counts[0] += value >= threshold
                counts[1] += value < threshold
