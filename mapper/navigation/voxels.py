"""Dense voxel grid of a box of the map, for distance fields and path search."""

from dataclasses import dataclass
from math import prod

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError, MapSizeError
from mapper.core.geometry import Array
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.keys import BLOCK_BITS, BLOCK_VOXELS, KEY_COUNT, KEY_ZERO, block_keys, gather
from mapper.octree.map import OctreeMap

LIMIT_BYTES = 2 << 30
"""Limit of the working space of a distance field or a plan."""

_BLOCK_EDGE = 1 << BLOCK_BITS


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """An axis-aligned box of the world.

    Attributes:
        low_world_m: (3,) lower corner.
        high_world_m: (3,) upper corner.
    """

    low_world_m: Array
    high_world_m: Array

    def __post_init__(self) -> None:
        if self.low_world_m.shape != (3,) or self.high_world_m.shape != (3,):
            raise DataError(
                f"box: corners {self.low_world_m.shape}, {self.high_world_m.shape}, want two of (3,)"
            )
        if (
            not (np.isfinite(self.high_world_m - self.low_world_m)).all()
            or not (self.low_world_m < self.high_world_m).all()
        ):
            raise DataError(
                f"box: from {self.low_world_m.tolist()} to {self.high_world_m.tolist()} m; "
                "want finite corners, the upper above the lower along each axis"
            )


@dataclass(frozen=True, slots=True, eq=False)
class VoxelGrid:
    """States of every voxel of a box; a slice is a grid of one layer.

    Attributes:
        states: (Z, Y, X) int8 of UNKNOWN, FREE and OCCUPIED.
        corner_world_m: (3,) lower x, y, z of voxel [0, 0, 0].
        resolution_m: Edge of a voxel.
    """

    states: NDArray[np.int8]
    corner_world_m: Array
    resolution_m: float

    def blocked(self, *, unknown_blocks: bool) -> NDArray[np.bool_]:
        """Return the (Z, Y, X) mask of occupied voxels and, if they block, of unknown ones."""
        blocked: NDArray[np.bool_] = (self.states == OCCUPIED) | ((self.states == UNKNOWN) & unknown_blocks)
        return blocked


def known_box(octree: OctreeMap) -> Box:
    """Return the box of all 8³ blocks, with a layer of unknown voxels around it.

    Raises:
        DataError: The map is empty.
    """
    codes = octree.blocks.codes
    if not len(codes):
        raise DataError("octree: the map is empty; fuse scans into it first")
    keys = block_keys(codes) - KEY_ZERO
    low, high = keys.min(axis=0) - 1, keys.max(axis=0) + _BLOCK_EDGE + 1
    return Box(low * octree.resolution_m, high * octree.resolution_m)


def cut_box(octree: OctreeMap, box: Box, *, bytes_per_voxel: int) -> VoxelGrid:
    """Return the states of all voxels that a box touches.

    Args:
        octree: The map.
        box: Part of the map; it may reach beyond known voxels, but not beyond the key range.
        bytes_per_voxel: Working space of the caller per voxel, these states included.

    Raises:
        MapSizeError: More space is needed; nothing has been allocated then.
        DataError: The box leaves the range of the map's keys.
    """
    # The allowance keeps a rounding from adding a layer where a face lies on a voxel's border.
    first = np.floor(box.low_world_m / octree.resolution_m + 1e-6).astype(np.int64) + KEY_ZERO
    last = np.ceil(box.high_world_m / octree.resolution_m - 1e-6).astype(np.int64) + KEY_ZERO - 1
    if (first < 0).any() or (last >= KEY_COUNT).any():
        raise DataError(
            f"box: from {box.low_world_m.tolist()} to {box.high_world_m.tolist()} m leaves "
            f"±{KEY_ZERO * octree.resolution_m:g} m, the reach of {octree.resolution_m:g} m voxels; shrink it"
        )
    counts = [int(n) for n in last - first + 1]
    needed_bytes = bytes_per_voxel * prod(counts)
    if needed_bytes > LIMIT_BYTES:
        raise MapSizeError(
            f"a box of {'×'.join(str(n) for n in counts)} voxels needs {needed_bytes / 2**30:.1f} GiB of "
            f"working space, the limit is {LIMIT_BYTES / 2**30:.1f}; choose a smaller box or a coarser map"
        )
    states = np.full(counts[::-1], UNKNOWN, dtype=np.int8)
    codes = octree.blocks.codes
    keys = block_keys(codes)
    slots = np.flatnonzero(((keys + _BLOCK_EDGE > first) & (keys <= last)).all(axis=1))
    _fill_states(codes[slots], slots, octree.blocks.table.values, octree.occupied_log_odds, first, states)
    corner_world_m = (first - KEY_ZERO).astype(np.float64) * octree.resolution_m
    return VoxelGrid(states, corner_world_m, octree.resolution_m)


def layer(grid: OccupancyGrid) -> VoxelGrid:
    """Return a 2D grid as one layer of voxels, surrounded by a ring of unknown cells."""
    states = np.pad(grid.cells, 1, constant_values=UNKNOWN)[np.newaxis]
    x, y = grid.origin_world_m - grid.resolution_m
    return VoxelGrid(states, np.array([x, y, -grid.resolution_m / 2.0]), grid.resolution_m)


@njit(cache=True, nogil=True)
def _fill_states(
    codes: NDArray[np.int64],
    slots: NDArray[np.int64],
    values: NDArray[np.float32],
    threshold: np.float32,
    first: NDArray[np.int64],
    states: NDArray[np.int8],
) -> None:
    """Write the states of the blocks' voxels to ``states`` (Z, Y, X); voxel [0, 0, 0] has key ``first``."""
    for b in range(len(codes)):
        for voxel in range(BLOCK_VOXELS):
            value = values[slots[b], voxel]
            if value != value:
                continue
            code = (codes[b] << (3 * BLOCK_BITS)) | voxel
            x, y, z = gather(code) - first[0], gather(code >> 1) - first[1], gather(code >> 2) - first[2]
            if 0 <= x < states.shape[2] and 0 <= y < states.shape[1] and 0 <= z < states.shape[0]:
                states[z, y, x] = OCCUPIED if value >= threshold else FREE
