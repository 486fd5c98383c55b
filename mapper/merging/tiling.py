"""Tiling: the cubes that a map is cut into, nodes of its octree at one depth and in its order."""

from dataclasses import dataclass
from math import log2

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import ConfigError
from mapper.core.geometry import Array
from mapper.octree.keys import BLOCK_BITS, KEY_BITS, KEY_ZERO, gather


@dataclass(frozen=True, slots=True)
class Tiling:
    """Size of the tiles.

    Attributes:
        resolution_m: Edge of a voxel.
        levels: Levels of the octree below a tile's top: its edge is 2 to this power, in voxels.
    """

    resolution_m: float
    levels: int

    @property
    def depth(self) -> int:
        """Depth of the tiles' tops in the octree."""
        return KEY_BITS - self.levels

    @property
    def voxels(self) -> int:
        """Edge of a tile in voxels."""
        return 1 << self.levels

    @property
    def edge_m(self) -> float:
        """Edge of a tile."""
        return self.voxels * self.resolution_m

    def tiles_of(self, block_codes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the tile, a Morton code at the tiles' depth, of each of (B,) block codes."""
        return block_codes >> (3 * (self.levels - BLOCK_BITS))

    def name_of(self, tile: int) -> str:
        """Return the path down the octree: a digit 0 … 7 for the child taken at each depth."""
        return f"{tile:0{self.depth}o}"

    def tile_named(self, name: str) -> int:
        """Return the tile of a name."""
        return int(name, 8)

    def first_key(self, tile: int) -> NDArray[np.int64]:
        """Return the (3,) key of a tile's lowest voxel."""
        return np.array([gather.py_func(tile >> axis) << self.levels for axis in range(3)], np.int64)

    def lower_m(self, tile: int) -> Array:
        """Return the (3,) lower corner of a tile in the map, metres."""
        return (self.first_key(tile) - KEY_ZERO).astype(np.float64) * self.resolution_m


def tiling_for(resolution_m: float, tile_m: float) -> Tiling:
    """Return the tiling whose edge, a power of two in voxels, is nearest to a length by ratio.

    Raises:
        ConfigError: The length is shorter than a block or longer than half of what keys can number.
    """
    lowest_m, highest_m = (resolution_m * (1 << bits) for bits in (BLOCK_BITS, KEY_BITS - 1))
    if not lowest_m <= tile_m <= highest_m:
        raise ConfigError(
            f"tile edge {tile_m:g} m: want {lowest_m:g} to {highest_m:g} m at {resolution_m:g} m a voxel"
        )
    return Tiling(resolution_m, round(log2(tile_m / resolution_m)))
