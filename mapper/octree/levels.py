"""The map at coarser levels: log-odds of the octree's inner nodes."""

import numpy as np
from numba import njit
from numpy import float32, int64
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Points
from mapper.octree.blocks import BlockStore
from mapper.octree.config import Parent
from mapper.octree.keys import BLOCK_BITS, BLOCK_DEPTH, BLOCK_VOXELS, KEY_BITS, codes_of, gather


def nodes_at(
    store: BlockStore, *, depth: int, parent: Parent
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return (M,) Morton codes and (M,) log-odds of the nodes of one depth in which anything is known.

    Args:
        store: The voxels.
        depth: 0, the root, … 16, the voxels.
        parent: Rule that joins children.

    Raises:
        DataError: No such depth or rule.
    """
    if not 0 <= depth <= KEY_BITS:
        raise DataError(f"octree: depth {depth}, want 0 (root) … {KEY_BITS} (voxels)")
    if parent not in ("max", "mean"):
        raise DataError(f"octree: parent {parent!r}, want 'max' or 'mean'")
    slots = store.sorted_slots()
    found: tuple[NDArray[np.int64], NDArray[np.float32]] = _block_nodes(
        store.codes[slots], slots, store.table.values, min(KEY_BITS - depth, BLOCK_BITS), parent == "mean"
    )
    for _ in range(depth, BLOCK_DEPTH):
        found = _parents(*found, parent == "mean")
    return found


def values_at_depth(
    store: BlockStore, points_world: Points, *, resolution_m: float, depth: int, parent: Parent
) -> NDArray[np.float32]:
    """Return the (N,) log-odds of the nodes of one depth around points; NaN is unknown or out of range.

    Args:
        store: The map's blocks.
        points_world: (N, 3) metres.
        resolution_m: Edge of a voxel.
        depth: Level of the tree, 0 (root) … 16 (voxels).
        parent: Log-odds of a node above the voxels: ``max`` or ``mean`` of its known children.

    Raises:
        DataError: No such depth or parent.
    """
    codes, values = nodes_at(store, depth=depth, parent=parent)
    values = np.append(values, np.float32(np.nan))
    wanted = codes_of(points_world, resolution_m) >> (3 * (KEY_BITS - depth))  # −1 stays −1
    at = np.searchsorted(codes, wanted)
    at[np.append(codes, -2)[at] != wanted] = len(codes)
    found: NDArray[np.float32] = values[at]
    return found


def keys_at_depth(codes: NDArray[np.int64]) -> NDArray[np.uint16]:
    """Return the (M, 3) keys, counted in nodes, of nodes' (M,) Morton codes."""
    return np.column_stack([gather.py_func(codes >> axis) for axis in range(3)]).astype(np.uint16)


@njit(cache=True, nogil=True)
def _join(values, mean):
    """Return the log-odds of the parent of eight nodes; NaN is unknown."""
    total, known, highest = 0.0, 0, float32(-np.inf)
    for i in range(8):
        if values[i] == values[i]:
            known += 1
            total += values[i]
            highest = max(highest, values[i])
    if known == 0:
        return float32(np.nan)
    return float32(total / known) if mean else highest


@njit(cache=True, nogil=True)
def _block_nodes(codes, slots, stored, levels, mean):
    """Return codes and values of the known nodes 0 … 3 levels above the voxels."""
    size = BLOCK_VOXELS >> (3 * levels)
    node_codes, node_values = np.empty(len(slots) * size, int64), np.empty(len(slots) * size, float32)
    values = np.empty(BLOCK_VOXELS, float32)
    count = 0
    for b in range(len(slots)):
        values[:] = stored[slots[b]]
        for level in range(levels):
            for i in range(BLOCK_VOXELS >> (3 * (level + 1))):
                values[i] = _join(values[8 * i : 8 * i + 8], mean)
        for i in range(size):
            if values[i] == values[i]:
                node_codes[count] = codes[b] * size + i
                node_values[count] = values[i]
                count += 1
    return node_codes[:count].copy(), node_values[:count].copy()


@njit(cache=True, nogil=True)
def _parents(codes, values, mean):
    """Return codes and values one level up; codes are in ascending order, and stay so."""
    up_codes, up_values = np.empty(len(codes), int64), np.empty(len(codes), float32)
    children = np.empty(8, float32)
    count, i = 0, 0
    while i < len(codes):
        up_codes[count] = codes[i] >> 3
        children[:] = np.nan
        while i < len(codes) and codes[i] >> 3 == up_codes[count]:
            children[codes[i] & 7] = values[i]
            i += 1
        up_values[count] = _join(children, mean)
        count += 1
    return up_codes[:count], up_values[:count]
