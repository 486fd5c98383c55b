"""The octree that blocks imply: pruned as OctoMap prunes, in the order in which its files list the nodes.

OctoMap's tree is canonical: an inner node holds the maximum of its children, and eight children that are
leaves of equal value become one leaf. So the voxels alone determine it, and files come out equal to the byte.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy import float32, int64, uint8, uint16
from numpy.typing import NDArray

from mapper.octree.blocks import BlockStore
from mapper.octree.keys import BLOCK_DEPTH, BLOCK_VOXELS

_LEVELS = (0, 512, 576, 584)
"""Where the nodes of depths 16, 15, 14 and 13 begin in the pyramid of a block."""
_PYRAMID = 585
_TOP = _PYRAMID - 1
_CHILD_UNKNOWN, _CHILD_FREE, _CHILD_OCCUPIED, _CHILD_INNER = 0, 1, 2, 3


class Tree(NamedTuple):
    """Nodes of depths 13 … 0, level after level, each level in Morton order; the root comes last.

    Attributes:
        values: (M,) float32 log-odds.
        masks: (M,) uint8, bit i set where child i exists; 0 for a leaf.
        first_children: (M,) int64 index of the lowest child; the others follow. −1 for a block.
        slots: (B,) int64 the blocks' slots; node b is block b.
        node_count: All nodes, those inside the blocks too.
        inner_count: Nodes with children.
    """

    values: NDArray[np.float32]
    masks: NDArray[np.uint8]
    first_children: NDArray[np.int64]
    slots: NDArray[np.int64]
    node_count: int
    inner_count: int


def build_tree(store: BlockStore, threshold: np.float32) -> Tree:
    """Return the pruned tree of a store with at least one block.

    Args:
        store: The blocks.
        threshold: Finite: every voxel counts as 1 (log-odds ≥ threshold) or 0, the maximum-likelihood map of
            ``.bt`` files. NaN: log-odds stay as they are.
    """
    slots = store.sorted_slots()
    values, masks, node_count, inner_count = _summarise(store.table.values, slots, threshold)
    levels = [(store.codes[slots], values, masks, np.full(len(slots), -1))]
    first = 0
    for _ in range(BLOCK_DEPTH):
        codes, values, masks, _ = levels[-1]
        levels.append(_parents(codes, values, masks, first))
        first += len(codes)
        node_count += int(np.bitwise_count(levels[-1][2]).sum())
        inner_count += np.count_nonzero(levels[-1][2])
    return Tree(
        values=np.concatenate([level[1] for level in levels]),
        masks=np.concatenate([level[2] for level in levels]),
        first_children=np.concatenate([level[3] for level in levels]),
        slots=slots,
        node_count=node_count + 1,  # every node but the root was counted as its parent's child
        inner_count=inner_count,
    )


def preorder(tree: Tree, store: BlockStore) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the value and the child mask of every node in preorder: the records of an ``.ot`` file."""
    values, masks = np.empty(tree.node_count, np.float32), np.empty(tree.node_count, np.uint8)
    _emit_nodes(tree, store.table.values, values, masks)
    return values, masks


def preorder_words(tree: Tree, store: BlockStore, threshold: np.float32) -> NDArray[np.uint16]:
    """Return the words of the inner nodes in preorder, two bits per child: the payload of a ``.bt`` file."""
    words = np.zeros(max(tree.inner_count, 1), np.uint16)  # the root has a word even if it is a leaf
    _emit_words(tree, store.table.values, threshold, words)
    return words


@njit(cache=True, nogil=True)
def _join(values, masks, first):
    """Return (value, mask) of the parent of eight nodes; a NaN value is an absent node, here and there."""
    mask, equal = 0, True
    highest = float32(np.nan)
    for i in range(8):
        value = values[first + i]
        if value == value:
            mask |= 1 << i
            highest = value if not highest >= value else highest
        equal &= masks[first + i] == 0 and value == values[first]
    return highest, uint8(0 if equal else mask)


@njit(cache=True, nogil=True)
def _raise_pyramid(block, threshold, values, masks):
    """Fill the pyramid of one block: its 512 voxels, then each level's parents."""
    if threshold == threshold:
        for i in range(BLOCK_VOXELS):
            values[i] = float32(block[i] >= threshold) if block[i] == block[i] else block[i]
    else:
        values[:BLOCK_VOXELS] = block
    for level in range(1, 4):
        child = _LEVELS[level - 1]
        for i in range(_LEVELS[level], _LEVELS[level] + (BLOCK_VOXELS >> (3 * level))):
            values[i], masks[i] = _join(values, masks, child)
            child += 8


@njit(cache=True, nogil=True)
def _summarise(stored, slots, threshold):
    """Return each block's top value and mask, how many nodes lie below the tops, how many have children."""
    n = len(slots)
    tops, top_masks = np.empty(n, float32), np.empty(n, uint8)
    values, masks = np.empty(_PYRAMID, float32), np.zeros(_PYRAMID, uint8)
    below, inner = 0, 0
    for b in range(n):
        _raise_pyramid(stored[slots[b]], threshold, values, masks)
        tops[b], top_masks[b] = values[_TOP], masks[_TOP]
        for i in range(BLOCK_VOXELS, _PYRAMID):
            inner += masks[i] != 0
            for child in range(8):
                below += (masks[i] >> child) & 1
    return tops, top_masks, below, inner


@njit(cache=True, nogil=True)
def _parents(codes, values, masks, offset):
    """Return (codes, values, masks, first_children) of the level above nodes in Morton order."""
    n = len(codes)
    up_codes, first_children = np.empty(n, int64), np.empty(n, int64)
    up_values, up_masks = np.empty(n, float32), np.empty(n, uint8)
    eight_values, eight_masks = np.empty(8, float32), np.zeros(8, uint8)
    count, i = 0, 0
    while i < n:
        up_codes[count], first_children[count] = codes[i] >> 3, offset + i
        eight_values[:] = np.nan
        while i < n and codes[i] >> 3 == up_codes[count]:
            eight_values[codes[i] & 7], eight_masks[codes[i] & 7] = values[i], masks[i]
            i += 1
        up_values[count], up_masks[count] = _join(eight_values, eight_masks, 0)
        count += 1
    return up_codes[:count], up_values[:count], up_masks[:count], first_children[:count]


@njit(cache=True, nogil=True)
def _push_children(tree, node, stack, top):
    """Put a node's children on the stack so that child 0 comes off first; return the stack's new top."""
    count = 0
    for child in range(8):
        count += (tree.masks[node] >> child) & 1
    for i in range(count):
        stack[top + i] = tree.first_children[node] + count - 1 - i
    return top + count


@njit(cache=True, nogil=True)
def _emit_nodes(tree, stored, out_values, out_masks):
    values, masks = np.empty(_PYRAMID, float32), np.zeros(_PYRAMID, uint8)
    stack = np.empty(8 * (BLOCK_DEPTH + 1), int64)
    stack[0] = len(tree.values) - 1
    top, at = 1, 0
    inner_stack = np.empty(32, int64)
    while top:
        top -= 1
        node = stack[top]
        if node >= len(tree.slots):
            out_values[at], out_masks[at] = tree.values[node], tree.masks[node]
            at += 1
            if tree.masks[node]:
                top = _push_children(tree, node, stack, top)
            continue
        _raise_pyramid(stored[tree.slots[node]], float32(np.nan), values, masks)
        inner_stack[0] = _TOP
        inner_top = 1
        while inner_top:
            inner_top -= 1
            inner = inner_stack[inner_top]
            out_values[at], out_masks[at] = values[inner], masks[inner]
            at += 1
            for child in range(7, -1, -1):
                if (masks[inner] >> child) & 1:
                    inner_stack[inner_top] = _child_of(inner) + child
                    inner_top += 1


@njit(cache=True, nogil=True)
def _child_of(inner):
    """Return the first of the eight children of a node of the pyramid."""
    if inner == _TOP:
        return _LEVELS[2]
    if inner >= _LEVELS[2]:
        return _LEVELS[1] + 8 * (inner - _LEVELS[2])
    return 8 * (inner - _LEVELS[1])


@njit(cache=True, nogil=True)
def _child_state(value, mask):
    if mask:
        return _CHILD_INNER
    return _CHILD_OCCUPIED if value > 0 else _CHILD_FREE


@njit(cache=True, nogil=True)
def _emit_words(tree, stored, threshold, words):
    values, masks = np.empty(_PYRAMID, float32), np.zeros(_PYRAMID, uint8)
    stack = np.empty(8 * (BLOCK_DEPTH + 1), int64)
    stack[0] = len(tree.values) - 1
    top, at = 1, 0
    inner_stack = np.empty(32, int64)
    while top:
        top -= 1
        node = stack[top]
        if not tree.masks[node]:
            continue
        if node >= len(tree.slots):
            child = tree.first_children[node]
            word = 0
            for i in range(8):
                if (tree.masks[node] >> i) & 1:
                    word |= _child_state(tree.values[child], tree.masks[child]) << (2 * i)
                    child += 1
            words[at] = uint16(word)
            at += 1
            top = _push_children(tree, node, stack, top)
            continue
        _raise_pyramid(stored[tree.slots[node]], threshold, values, masks)
        inner_stack[0] = _TOP
        inner_top = 1
        while inner_top:
            inner_top -= 1
            inner = inner_stack[inner_top]
            first = _child_of(inner)
            word = 0
            for child in range(7, -1, -1):
                if (masks[inner] >> child) & 1:
                    state = _child_state(values[first + child], masks[first + child])
                    word |= state << (2 * child)
                    if state == _CHILD_INNER:
                        inner_stack[inner_top] = first + child
                        inner_top += 1
            words[at] = uint16(word)
            at += 1
