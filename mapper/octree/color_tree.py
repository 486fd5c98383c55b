"""Colours of the nodes of a ColorOcTree, as OctoMap computes them when it prunes and updates inner nodes."""

import numpy as np
from numba import njit
from numpy import int64, uint8
from numpy.typing import NDArray

from mapper.octree.attributes import UNSET, AttributeLayer
from mapper.octree.keys import BLOCK_BITS, BLOCK_VOXELS, KEY_BITS
from mapper.octree.octomap_tree import enter_next_child
from mapper.octree.sparse_grid import BlockStore

COLOR_NODE = np.dtype([("value", "<f4"), ("rgb", "u1", 3), ("mask", "u1")])
"""A node as a ColorOcTree's ``.ot`` file lists it: log-odds, RGB, and a bit for each child that exists."""


def color_nodes(
    nodes: NDArray[np.void],
    store: BlockStore,
    attributes: AttributeLayer,
    *,
    root_depth: int = 0,
    root_code: int = 0,
) -> NDArray[np.void]:
    """Return (N,) COLOR_NODE: the nodes of a pruned tree in preorder, with their colours.

    A leaf above the voxels has the mean colour of the voxels that were pruned into it, and an inner node that
    of its children, level by level, rounded down; white is no colour. As in OctoMap, a pruned node is white
    if its first child was.

    Args:
        nodes: (N,) NODE of the same map.
        store: Its blocks.
        attributes: Their attributes.
        root_depth: Depth of the first node.
        root_code: Morton code of the first node at its depth.
    """
    out = np.empty(len(nodes), COLOR_NODE)
    out["value"], out["mask"] = nodes["value"], nodes["mask"]
    slots = attributes.slots
    colors = attributes.block_colors(slots)
    rgb = np.empty((len(nodes), 3), np.uint8)
    masks = np.ascontiguousarray(nodes["mask"])
    _colors_in_preorder(masks, store.codes[slots], colors, root_depth, root_code, rgb)
    out["rgb"] = rgb
    return out


def parent_color(children: NDArray[np.uint8], *, pruned: bool) -> NDArray[np.uint8]:
    """Return the (3,) colour of the parent of eight nodes, given their (8, 3) colours, white where absent.

    Args:
        children: uint8 RGB.
        pruned: The children were leaves of equal value and are no longer stored.
    """
    if pruned:
        return np.asarray(_pruned(children.copy()))
    colored = (children != UNSET).any(axis=1)
    return np.asarray(_mean(children[colored].sum(axis=0, dtype=np.int64), np.count_nonzero(colored)))


@njit(cache=True, nogil=True)
def _colors_in_preorder(masks, codes, colors, root_depth, root_code, rgb):
    """Write the (N, 3) colours of nodes.

    Args:
        masks: (N,) uint8 of the nodes in preorder.
        codes: (B,) int64 increasing codes of the blocks that have colours.
        colors: (B, 512, 3) uint8 colours of their voxels.
        root_depth: Depth of the first node.
        root_code: Its Morton code at that depth.
        rgb: (N, 3) uint8 result.
    """
    pending, index = np.zeros(KEY_BITS + 1, int64), np.zeros(KEY_BITS + 1, int64)
    prefix = np.zeros(KEY_BITS + 2, int64)
    sums, counts = np.zeros((KEY_BITS + 1, 3), int64), np.zeros(KEY_BITS + 1, int64)
    depth = root_depth
    prefix[depth] = root_code
    for i in range(len(masks)):
        pending[depth], index[depth] = masks[i], i
        sums[depth], counts[depth] = 0, 0
        if masks[i] == 0:
            rgb[i] = _leaf_color(prefix[depth], depth, codes, colors)
        while depth >= root_depth and pending[depth] == 0:
            node = index[depth]
            if masks[node]:
                rgb[node] = _mean(sums[depth], counts[depth])
            depth -= 1
            if depth >= root_depth and _is_set(rgb[node]):
                counts[depth] += 1
                for channel in range(3):
                    sums[depth, channel] += rgb[node, channel]
        if depth >= root_depth:
            depth = enter_next_child(pending, prefix, depth)


@njit(cache=True, nogil=True)
def _leaf_color(prefix, depth, codes, colors):
    """Return the (3,) colour of the leaf that the voxels below a node were pruned into."""
    levels = KEY_BITS - depth
    voxels = int64(1) << (3 * levels)
    first = prefix << (3 * levels)
    color = np.full(3, UNSET, uint8)
    at = np.searchsorted(codes, first >> (3 * BLOCK_BITS))
    end = np.searchsorted(codes, ((first + voxels - 1) >> (3 * BLOCK_BITS)) + 1)
    if at == end:
        return color
    if levels <= BLOCK_BITS:
        start = first & (BLOCK_VOXELS - 1)
        below = colors[at, start : start + voxels].copy()
    else:
        below = np.full((voxels >> (3 * BLOCK_BITS), 3), UNSET, uint8)
        for block in range(at, end):
            below[codes[block] - (first >> (3 * BLOCK_BITS))] = _pruned(colors[block].copy())
    return _pruned(below)


@njit(cache=True, nogil=True)
def _pruned(colors):
    """Return the (3,) colour that (8^n, 3) colours are pruned to; ``colors`` is overwritten."""
    size = len(colors)
    while size > 1:
        size //= 8
        for i in range(size):
            count = 0
            sums = np.zeros(3, int64)
            for child in range(8 * i, 8 * i + 8):
                if _is_set(colors[child]):
                    count += 1
                    for channel in range(3):
                        sums[channel] += colors[child, channel]
            colors[i] = _mean(sums, count if _is_set(colors[8 * i]) else 0)
    return colors[0]


@njit(cache=True, nogil=True)
def _is_set(color):
    return color[0] != UNSET or color[1] != UNSET or color[2] != UNSET


@njit(cache=True, nogil=True)
def _mean(sums, count):
    color = np.full(3, UNSET, uint8)
    if count:
        for channel in range(3):
            color[channel] = sums[channel] // count
    return color
