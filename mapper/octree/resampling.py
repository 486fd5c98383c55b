"""Resampling of a map into another frame by nearest neighbours: every voxel takes the value at its centre.

There are no holes, log-odds are not mixed, and a wall one voxel thick stays closed; an edge may be displaced
by up to half a voxel's diagonal.
"""

from math import floor

import numpy as np
from numba import njit
from numpy import int64
from numpy.typing import NDArray

from mapper.core.errors import MapSizeError
from mapper.core.geometry import Transform
from mapper.octree.attributes import AttributeLayer, LayerArrays
from mapper.octree.config import OctreeConfig
from mapper.octree.keys import (
    BLOCK_BITS,
    BLOCK_DEPTH,
    BLOCK_EDGE,
    BLOCK_VOXELS,
    KEY_COUNT,
    KEY_ZERO,
    block_keys,
    centre_of,
    codes_of_keys,
    gather,
    morton,
)
from mapper.octree.map import OctreeMap
from mapper.octree.sparse_grid import slot_of


def blocks_reached(octree: OctreeMap, T_map_world: Transform) -> NDArray[np.int64]:
    """Return increasing codes of the blocks in the map's frame that a run's map may overlap.

    Args:
        octree: The run's map, in its world.
        T_map_world: (4, 4) pose of that world in the map.

    Raises:
        MapSizeError: The run's map would reach beyond the range of keys.
    """
    middles = block_keys(octree.blocks.codes) - KEY_ZERO + BLOCK_EDGE // 2
    moved = middles @ T_map_world[:3, :3].T + T_map_world[:3, 3] / octree.resolution_m
    reach = BLOCK_EDGE // 2 * np.abs(T_map_world[:3, :3]).sum(axis=1)
    lowest, highest = (np.floor((moved + side * reach) / BLOCK_EDGE).astype(np.int64) for side in (-1, 1))
    limit = 1 << (BLOCK_DEPTH - 1)
    if len(moved) and (lowest.min() < -limit or highest.max() >= limit):
        raise MapSizeError(
            f"placed there, it reaches {np.abs(moved).max() * octree.resolution_m:.0f} m from the map's "
            f"origin; an octree of {octree.resolution_m:g} m ends at {KEY_ZERO * octree.resolution_m:g} m"
        )
    found = []
    for step in np.ndindex(3, 3, 3):  # a rotated block is at most √3 blocks wide
        blocks = lowest + step
        found.append(np.unique(codes_of_keys(blocks[(blocks <= highest).all(axis=1)] + limit)))
    return np.unique(np.concatenate(found))


def resample(
    octree: OctreeMap, T_world_map: Transform, codes: NDArray[np.int64], config: OctreeConfig
) -> OctreeMap:
    """Return another map's voxels resampled into blocks; blocks without a known voxel are left out.

    Args:
        octree: The other map, in its own world.
        T_world_map: (4, 4) pose of the map's frame in that world.
        codes: (B,) increasing codes of blocks in the map's frame.
        config: Settings of the result; with attributes, they are resampled too.
    """
    sources = _sources(octree.blocks.table, codes, np.ascontiguousarray(T_world_map), octree.resolution_m)
    values = octree.blocks.table.values.reshape(-1)[np.maximum(sources, 0)]
    known = (sources >= 0) & ~np.isnan(values)
    kept = known.any(axis=1)
    sources, known = sources[kept], known[kept]
    moved = OctreeMap(config)
    moved.restore_blocks(codes[kept], known, values[kept][known])
    if moved.attributes is not None and octree.attributes is not None:
        rows = np.full(len(octree.blocks), -1, np.int32)
        rows[: len(octree.attributes.arrays.rows)] = octree.attributes.arrays.rows
        rows = np.where(known, rows[sources // BLOCK_VOXELS], np.int32(-1))
        _copy_attributes(moved, moved.attributes, octree.attributes, rows, sources % BLOCK_VOXELS)
    return moved


def _copy_attributes(
    moved: OctreeMap,
    own: AttributeLayer,
    other: AttributeLayer,
    rows: NDArray[np.int32],
    voxels: NDArray[np.int64],
) -> None:
    """Copy the attributes of (B, 512) voxels from their (B, 512) rows, −1 for none, and voxel numbers."""
    held = (rows >= 0).any(axis=1)
    into = own.claim(moved.blocks.sorted_slots()[held])
    blocks, targets = np.nonzero(rows[held] >= 0)
    source = rows[held][blocks, targets], voxels[held][blocks, targets]
    for name in LayerArrays._fields[1:]:
        getattr(own.arrays, name)[into[blocks], targets] = getattr(other.arrays, name)[source]


@njit(cache=True, nogil=True)
def _sources(table, codes, T_world_map, resolution_m):
    """Return (B, 512) int64: slot · 512 + voxel of the source at each voxel's centre; −1 is none."""
    sources = np.full((len(codes), BLOCK_VOXELS), -1, int64)
    T, inverse_resolution = T_world_map, 1.0 / resolution_m
    key = np.empty(3, int64)
    last, slot = int64(-1), int64(-1)
    for b in range(len(codes)):
        for voxel in range(BLOCK_VOXELS):
            code = (codes[b] << (3 * BLOCK_BITS)) | voxel
            x = centre_of(gather(code), resolution_m)
            y = centre_of(gather(code >> 1), resolution_m)
            z = centre_of(gather(code >> 2), resolution_m)
            inside = True
            for axis in range(3):
                metres = T[axis, 0] * x + T[axis, 1] * y + T[axis, 2] * z + T[axis, 3]
                key[axis] = int64(floor(inverse_resolution * metres)) + KEY_ZERO
                inside &= 0 <= key[axis] < KEY_COUNT
            if inside:
                source = morton(key[0], key[1], key[2])
                if source >> (3 * BLOCK_BITS) != last:
                    last = source >> (3 * BLOCK_BITS)
                    slot = slot_of(table, last)
                if slot >= 0:
                    sources[b, voxel] = slot * BLOCK_VOXELS + (source & (BLOCK_VOXELS - 1))
    return sources
