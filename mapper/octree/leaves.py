"""Results of octree queries: known voxels, and the ends of rays cast through the map."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points
from mapper.octree import queries
from mapper.octree.blocks import BlockStore
from mapper.octree.keys import KEY_BITS, KEY_ZERO

_CHUNK = 1 << 12
"""Blocks whose voxels are listed at once: 70 MB at most."""


@dataclass(frozen=True, slots=True, eq=False)
class Leaves:
    """Known voxels, or nodes above them, in Morton order.

    Attributes:
        keys: (N, 3) uint16 keys as in OctoMap; above the voxels they count nodes.
        log_odds: (N,) float32.
        resolution_m: Edge of a voxel.
        depth: Depth of the nodes in the tree; 16 is that of the voxels.
    """

    keys: NDArray[np.uint16]
    log_odds: NDArray[np.float32]
    resolution_m: float
    depth: int = KEY_BITS

    @property
    def edge_m(self) -> float:
        """Edge of a node."""
        return self.resolution_m * (1 << (KEY_BITS - self.depth))

    @property
    def centres_world(self) -> Points:
        """(N, 3) float64 centres, metres."""
        voxels = 1 << (KEY_BITS - self.depth)
        return (self.keys.astype(np.float64) * voxels - (KEY_ZERO - 0.5 * voxels)) * self.resolution_m


@dataclass(frozen=True, slots=True, eq=False)
class RayEnds:
    """Ends of rays cast through the map.

    Attributes:
        centres_world: (N, 3) float64 centre of the last voxel, metres.
        distances_m: (N,) float64 from the ray's origin to that centre.
        hits: (N,) bool, true where that voxel is occupied.
    """

    centres_world: Points
    distances_m: Array
    hits: NDArray[np.bool_]


def known_leaves(store: BlockStore, slots: NDArray[np.int64], resolution_m: float) -> Leaves:
    """Return the known voxels of some blocks, (B,) by their slots, in that order."""
    keys, values = queries.known_voxels(store.codes[slots], slots, store.table.values)
    return Leaves(keys, values, resolution_m)


def centres_where(
    store: BlockStore, resolution_m: float, holds: Callable[[NDArray[np.float32]], NDArray[np.bool_]]
) -> Points:
    """Return the (N, 3) centres, metres, of the voxels whose log-odds meet a condition, in Morton order."""
    slots, parts = store.sorted_slots(), [np.empty((0, 3))]
    for first in range(0, len(slots), _CHUNK):
        known = known_leaves(store, slots[first : first + _CHUNK], resolution_m)
        kept = holds(known.log_odds)
        parts.append(Leaves(known.keys[kept], known.log_odds[kept], resolution_m).centres_world)
    return np.concatenate(parts)
