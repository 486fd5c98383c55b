"""What an octree returns: its known voxels, and the ends of rays cast through it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points
from mapper.octree.keys import KEY_BITS, KEY_ZERO


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
