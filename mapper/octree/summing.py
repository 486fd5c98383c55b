"""Independent maps of the same voxels, added."""

from typing import NamedTuple

from numba import njit
from numpy import float32

from mapper.octree.keys import BLOCK_VOXELS


class Overlap(NamedTuple):
    """What two maps say about the voxels that both know.

    Attributes:
        shared: Voxels that both know.
        both_occupied: Those that are occupied in both.
        either_occupied: Those that are occupied in one of them at least.
    """

    shared: int
    both_occupied: int
    either_occupied: int


@njit(cache=True, nogil=True)
def add_blocks(stored, slots, others, other_slots, threshold):
    """Add log-odds block by block; where one map knows nothing the other's stay.

    Args:
        stored: (capacity, 512) float32 log-odds that are added to; NaN is unknown.
        slots: (B,) rows of the blocks.
        others: (C, 512) float32 of the other map.
        other_slots: (B,) rows of the same blocks there.
        threshold: Log-odds from which a voxel is occupied.

    Returns:
        How many voxels became known, and the three counts of an Overlap.
    """
    born, shared, both, either = 0, 0, 0, 0
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
                born += 1
                own[i] = there
    return born, (shared, both, either)
