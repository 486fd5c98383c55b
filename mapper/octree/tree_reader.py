"""Reading of OctoMap trees: leaves from the node records of files, and blocks from leaves."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy import float32, int64, uint8
from numpy.typing import NDArray

from mapper.octree.blocks import BLOCK_BYTES, BlockStore, check_memory
from mapper.octree.keys import BLOCK_BITS, BLOCK_DEPTH, BLOCK_VOXELS, KEY_BITS

WHOLE, CUT_SHORT, TRAILING, TOO_DEEP, CHILDLESS = 0, 1, 2, 3, 4
"""Verdicts on the records of a file: a whole tree, or the fault that was found."""


class TreeLeaves(NamedTuple):
    """Leaves of a pruned tree in Morton order.

    Attributes:
        codes: (L,) int64 Morton code of each leaf's first voxel.
        depths: (L,) uint8, 16 for a single voxel.
        values: (L,) float32 log-odds.
    """

    codes: NDArray[np.int64]
    depths: NDArray[np.uint8]
    values: NDArray[np.float32]


def fill(store: BlockStore, leaves: TreeLeaves) -> int:
    """Write leaves into an empty store at the finest level; return the number of voxels that become known.

    Raises:
        MapSizeError: Expanded, the map would not fit into this machine's memory.
    """
    edge_levels = np.maximum(BLOCK_DEPTH - leaves.depths.astype(np.int64), 0)
    large = int((np.int64(1) << (3 * edge_levels[edge_levels > 0])).sum())
    small_codes = leaves.codes[edge_levels == 0] >> (3 * BLOCK_BITS)
    small = int(np.count_nonzero(np.diff(small_codes))) + (len(small_codes) > 0)
    check_memory((large + small) * BLOCK_BYTES, "the map with its pruned leaves expanded")
    slots = store.claim(_block_codes(leaves, large + small))
    _fill_blocks(leaves, slots, store.table.values)
    return int((np.int64(1) << (3 * (KEY_BITS - leaves.depths.astype(np.int64)))).sum())


@njit(cache=True, nogil=True)
def leaves_of_nodes(values, masks):
    """Return the leaves of an ``.ot`` file's (M,) records in preorder, and the verdict on them."""
    n = len(masks)
    codes, depths, found = np.empty(n, int64), np.empty(n, uint8), np.empty(n, float32)
    pending = np.zeros(KEY_BITS + 1, int64)  # per depth on the path: children still to come
    prefix = np.zeros(KEY_BITS + 2, int64)
    depth, count, verdict = 0, 0, WHOLE
    for i in range(n):
        if depth < 0:
            verdict = TRAILING
            break
        if masks[i] == 0:
            codes[count] = prefix[depth] << (3 * (KEY_BITS - depth))
            depths[count], found[count] = depth, values[i]
            count += 1
            depth -= 1
        elif depth == KEY_BITS:
            verdict = TOO_DEEP
            break
        else:
            pending[depth] = masks[i]
        while depth >= 0 and pending[depth] == 0:
            depth -= 1
        if depth >= 0:
            depth = enter_next_child(pending, prefix, depth)
    if depth >= 0 and verdict == WHOLE:
        verdict = CUT_SHORT
    return TreeLeaves(codes[:count], depths[:count], found[:count]), verdict


@njit(cache=True, nogil=True)
def enter_next_child(pending, prefix, depth):
    """Go down from a node to its lowest child that is still to come; return the child's depth.

    Args:
        pending: Bits, by depth on the path, for each child that is still to come; the child's is cleared.
        prefix: Morton codes, by depth, of the nodes on the path; the child's is written.
        depth: Depth of the node.
    """
    child = 0
    while not (pending[depth] >> child) & 1:
        child += 1
    pending[depth] &= ~(1 << child)
    prefix[depth + 1] = (prefix[depth] << 3) | child
    return depth + 1


@njit(cache=True, nogil=True)
def leaves_of_words(words, node_count, free, occupied):
    """Return the leaves of a ``.bt`` file's words, the number of nodes they describe, and the verdict.

    Args:
        words: (W,) uint16 in preorder.
        node_count: Number of nodes by the header; bounds the leaves.
        free: Log-odds of free leaves.
        occupied: Log-odds of occupied leaves.
    """
    codes, depths = np.empty(node_count, int64), np.empty(node_count, uint8)
    values = np.empty(node_count, float32)
    pending = np.zeros(KEY_BITS + 1, int64)  # per depth on the path: the word, finished children zeroed
    prefix = np.zeros(KEY_BITS + 2, int64)
    count, nodes, at, verdict = 0, 1, 1, WHOLE
    pending[0] = words[0]
    depth = 0
    while depth >= 0:
        if pending[depth] == 0:
            depth -= 1
            continue
        child = 0
        while not (pending[depth] >> (2 * child)) & 3:
            child += 1
        state = (pending[depth] >> (2 * child)) & 3
        pending[depth] &= ~(3 << (2 * child))
        prefix[depth + 1] = (prefix[depth] << 3) | child
        nodes += 1
        if nodes > node_count:
            break
        if state == 3:
            depth += 1
            if depth == KEY_BITS:
                verdict = TOO_DEEP
            elif at == len(words):
                verdict = CUT_SHORT
            elif words[at] == 0:
                verdict = CHILDLESS
            if verdict != WHOLE:
                break
            pending[depth] = words[at]
            at += 1
        else:
            codes[count] = prefix[depth + 1] << (3 * (KEY_BITS - depth - 1))
            depths[count], values[count] = depth + 1, free if state == 1 else occupied
            count += 1
    if depth < 0 and at < len(words):
        verdict = TRAILING
    return TreeLeaves(codes[:count], depths[:count], values[:count]), nodes, verdict


@njit(cache=True, nogil=True)
def _block_codes(leaves, count):
    """Return the (count,) distinct block codes of leaves; Morton order keeps equal ones together."""
    codes = np.empty(count, int64)
    at = 0
    for i in range(len(leaves.codes)):
        code = leaves.codes[i] >> (3 * BLOCK_BITS)
        spanned = 1 << (3 * max(BLOCK_DEPTH - int64(leaves.depths[i]), 0))
        if at and codes[at - 1] == code:
            continue
        for block in range(spanned):
            codes[at] = code + block
            at += 1
    return codes


@njit(cache=True, nogil=True)
def _fill_blocks(leaves, slots, stored):
    """Write leaves into the blocks that :func:`_block_codes` listed."""
    at, previous = -1, int64(-1)
    for i in range(len(leaves.codes)):
        code = leaves.codes[i] >> (3 * BLOCK_BITS)
        if code != previous:
            at += 1
            previous = code
        depth = int64(leaves.depths[i])
        if depth < BLOCK_DEPTH:
            spanned = 1 << (3 * (BLOCK_DEPTH - depth))
            for block in range(spanned):
                stored[slots[at + block]] = leaves.values[i]
            at += spanned - 1
            previous = code + spanned - 1
        else:
            first = leaves.codes[i] & (BLOCK_VOXELS - 1)
            stored[slots[at], first : first + (1 << (3 * (KEY_BITS - depth)))] = leaves.values[i]
