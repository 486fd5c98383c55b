"""Sum of independent maps: log-odds of the same voxels are added."""

from typing import NamedTuple

from numba import njit
from numpy import float32

from mapper.octree.keys import BLOCK_VOXELS


class Overlap(NamedTuple):
    """Agreement of two maps about their common voxels.

    Attributes:
        shared: Number of voxels that are known in both maps.
        both_occupied: Number of voxels that are occupied in both.
        either_occupied: Number of voxels that are occupied in at least one.
    """

    shared: int
    both_occupied: int
    either_occupied: int


@njit(cache=True, nogil=True)
def add_blocks(stored, slots, others, other_slots, threshold):
    """Add another map's log-odds block by block; a voxel that is known in one map keeps that value.

    Args:
        stored: (capacity, 512) float32 log-odds, updated; NaN is unknown.
        slots: (B,) rows of the blocks.
        others: (C, 512) float32 log-odds of the other map.
        other_slots: (B,) rows of the same blocks there.
        threshold: Log-odds from which a voxel is occupied.

    Returns:
        Number of voxels that became known, and the three counts of an Overlap.
    """
    added, shared, both, either = 0, 0, 0, 0
    for b in range(len(slots)):
        own, other = stored[slots[b]], others[other_slots[b]]
        for i in range(BLOCK_VOXELS):
            here, there = own[i], other[i]
            if here == here and there == there:
                shared += 1
                both += (here >= threshold) & (there >= threshold)
                either += (here >= threshold) | (there >= threshold)
                own[i] = float32(here + there)
            elif there == there:
                added += 1
                own[i] = there
    return added, (shared, both, either)
