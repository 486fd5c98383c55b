"""OctoMap's trees in blocks and back: nodes pruned as OctoMap prunes them, in the order of its files.

OctoMap's tree is canonical: an inner node holds the maximum of its children, and eight children that are
leaves of equal value become one leaf. So the voxels alone determine it, and files come out equal to the byte.
In preorder the blocks follow one another in Morton order. So each block's part is written once, one after
another, and the few nodes above the blocks are put between them at the end.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy import float32, int64, uint8, uint16
from numpy.typing import NDArray

from mapper.octree.keys import BLOCK_DEPTH, BLOCK_EDGE, BLOCK_VOXELS
from mapper.octree.sparse_grid import BLOCKS_AT_ONCE, BlockStore

NODE = np.dtype([("value", "<f4"), ("mask", "u1")])
"""A node as in an ``.ot`` file: log-odds, and a bit for each child that exists."""

_PAIRS = BLOCK_VOXELS
_QUADS = _PAIRS + BLOCK_VOXELS // 8
_TOP = _QUADS + BLOCK_EDGE
"""Index in the pyramid of a block at which the nodes of edge 2, 4 and 8 voxels begin, after its voxels."""
_PYRAMID = _TOP + 1
_WORDS = _PYRAMID - BLOCK_VOXELS
_STACK = 8 * (BLOCK_DEPTH + 1)
_FREE, _OCCUPIED, _INNER = range(1, 4)


class UpperNodes(NamedTuple):
    """Nodes from the tops of subtrees up to the root, level after level, each in Morton order.

    Subtrees are blocks, whose tops have depth 13, or larger tiles.

    Attributes:
        nodes: (M,) NODE; the first B are the tops, the last is the root.
        first_children: (M,) int64 index of the lowest child, which the others follow; −1 for a top.
        starts: (B + 1,) int64 start of each subtree's part, and the end of the last.
    """

    nodes: NDArray[np.void]
    first_children: NDArray[np.int64]
    starts: NDArray[np.int64]


def preorder_of(store: BlockStore, *, root_depth: int = 0) -> tuple[int, Iterator[NDArray[np.void]]]:
    """Return the number of a map's nodes, and its nodes in preorder, (N,) NODE at a time.

    They are the payload of an ``.ot`` file. This takes a tenth of the map's memory and 100 MB.

    Args:
        store: Store of at least one block.
        root_depth: Depth of a node above all blocks that serves as root; it is listed first.
    """
    slots = store.sorted_slots()
    tops, sizes = np.empty(len(slots), NODE), np.empty(len(slots), np.int64)
    for first in range(0, len(slots), BLOCKS_AT_ONCE):
        some = slice(first, first + BLOCKS_AT_ONCE)
        parts, starts = _block_nodes(store, slots[some])
        tops[some], sizes[some] = parts[starts[:-1]], np.diff(starts)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    upper = upper_nodes(store.codes[slots], tops, starts, levels=BLOCK_DEPTH - root_depth)
    order = preorder(upper)
    is_block = order < len(slots)
    count = int(sizes[order[is_block]].sum() + np.count_nonzero(~is_block))
    return count, _pieces(store, slots, upper, order)


def _pieces(
    store: BlockStore, slots: NDArray[np.int64], upper: UpperNodes, order: NDArray[np.int64]
) -> Iterator[NDArray[np.void]]:
    """Yield the nodes of blocks, and of those above them, in an order of upper nodes."""
    for first in range(0, len(order), BLOCKS_AT_ONCE):
        some = order[first : first + BLOCKS_AT_ONCE]
        blocks = some[some < len(slots)]
        parts, starts = _block_nodes(store, slots[blocks])
        piece = np.empty(starts[-1] + len(some) - len(blocks), NODE)
        _assemble_nodes(upper, some, parts, starts, piece)
        yield piece


def nodes_in_preorder(store: BlockStore, *, root_depth: int = 0) -> NDArray[np.void]:
    """Return (N,) NODE, all of ``preorder_of``."""
    return np.concatenate(list(preorder_of(store, root_depth=root_depth)[1]))


def _block_nodes(store: BlockStore, slots: NDArray[np.int64]) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    """Return blocks' nodes, each block's in preorder, and the start of each block's."""
    parts, starts = np.empty(len(slots) * _PYRAMID, NODE), np.zeros(len(slots) + 1, np.int64)
    _write_nodes(store.table.values, slots, parts, starts)
    return parts, starts


def words_in_preorder(
    store: BlockStore, threshold: np.float32, *, root_depth: int = 0
) -> tuple[NDArray[np.uint16], np.void]:
    """Return (W,) uint16, the words of a ``.bt`` file, one for each inner node, and the root's NODE.

    Args:
        store: Store of at least one block.
        threshold: Log-odds from which a voxel is occupied.
        root_depth: Depth of a node above all blocks that serves as root.
    """
    slots = store.sorted_slots()
    parts, starts = np.empty(len(slots) * _WORDS, np.uint16), np.zeros(len(slots) + 1, np.int64)
    tops = np.empty(len(slots), NODE)
    _write_words(store.table.values, slots, threshold, parts, starts, tops)
    upper = upper_nodes(store.codes[slots], tops, starts, levels=BLOCK_DEPTH - root_depth)
    payload = np.zeros(starts[-1] + len(upper.nodes), np.uint16)
    return payload[: _assemble_words(upper, parts, payload)], upper.nodes[-1]


def children_in(words: NDArray[np.uint16]) -> int:
    """Return the number of nodes that the words of a ``.bt`` file describe: all but the root."""
    return int(np.bitwise_count((words | (words >> 1)) & 0x5555).sum(dtype=np.int64))


def upper_nodes(
    codes: NDArray[np.int64], tops: NDArray[np.void], starts: NDArray[np.int64], *, levels: int
) -> UpperNodes:
    """Return the nodes above subtrees that all have their tops at one depth.

    Args:
        codes: (B,) increasing Morton codes of the tops, at their own depth.
        tops: (B,) NODE.
        starts: (B + 1,) start of each subtree's part of a payload.
        levels: Levels from the tops to the root.
    """
    above = [(codes, tops, np.full(len(codes), -1))]
    first = 0
    for _ in range(levels):
        codes, nodes, _ = above[-1]
        above.append(_parents(codes, nodes, first))
        first += len(codes)
    nodes, first_children = (np.concatenate([level[i] for level in above]) for i in (1, 2))
    return UpperNodes(nodes, first_children, starts)


def word_of(upper: UpperNodes, node: int) -> NDArray[np.uint16]:
    """Return the (1,) uint16 word of an upper node that has children."""
    word = np.empty(1, np.uint16)
    _write_upper_word(upper, node, word, 0, np.empty(8, np.float32), np.empty(8, np.uint8))
    return word


@njit(cache=True, nogil=True)
def preorder(upper):
    """Return the indices of the upper nodes in preorder, without those below a node that was pruned."""
    order, stack = np.empty(len(upper.nodes), int64), np.empty(_STACK, int64)
    stack[0] = len(upper.nodes) - 1
    top, count = 1, 0
    while top:
        top -= 1
        node = order[count] = stack[top]
        count += 1
        if node < len(upper.starts) - 1:
            continue
        children = 0
        for child in range(8):
            children += (upper.nodes[node].mask >> child) & 1
        for i in range(children):  # the lowest comes off the stack first
            stack[top + i] = upper.first_children[node] + children - 1 - i
        top += children
    return order[:count]


@njit(cache=True, nogil=True)
def _join(values, masks, first):
    """Return (value, mask) of the parent of eight nodes; a NaN value is an absent node."""
    mask, leaves = 0, 0
    equal = True
    highest = float32(-np.inf)
    for i in range(8):
        value = values[first + i]
        mask |= int64(value == value) << i
        highest = value if value > highest else highest
        equal &= value == values[first]
        leaves |= masks[first + i]
    return highest if mask else float32(np.nan), uint8(0 if equal and leaves == 0 else mask)


@njit(cache=True, nogil=True)
def _raise_pyramid(values, masks):
    """Fill the pyramid above the 512 voxels that ``values`` begins with; their masks are 0."""
    for i in range(_PAIRS, _QUADS):
        values[i], masks[i] = _join(values, masks, 8 * (i - _PAIRS))
    for i in range(_QUADS, _TOP):
        values[i], masks[i] = _join(values, masks, _PAIRS + 8 * (i - _QUADS))
    values[_TOP], masks[_TOP] = _join(values, masks, _QUADS)


@njit(cache=True, nogil=True)
def _write_nodes(stored, slots, parts, starts):
    """Write each block's nodes in preorder, and the start of each block's part to ``starts``."""
    values, masks = np.empty(_PYRAMID, float32), np.zeros(_PYRAMID, uint8)
    at = 0
    for b in range(len(slots)):
        block = stored[slots[b]]
        for i in range(BLOCK_VOXELS):
            values[i] = block[i]
        _raise_pyramid(values, masks)
        at = _write_node(parts, at, values[_TOP], masks[_TOP])
        for quad in range(8):
            if (masks[_TOP] >> quad) & 1:
                at = _write_node(parts, at, values[_QUADS + quad], masks[_QUADS + quad])
                for pair in range(8 * quad, 8 * quad + 8):
                    if (masks[_QUADS + quad] >> (pair & 7)) & 1:
                        at = _write_node(parts, at, values[_PAIRS + pair], masks[_PAIRS + pair])
                        if masks[_PAIRS + pair]:
                            for voxel in range(8):  # without a branch: an absent voxel is written over
                                parts[at].value, parts[at].mask = values[8 * pair + voxel], 0
                                at += (masks[_PAIRS + pair] >> voxel) & 1
        starts[b + 1] = at


@njit(cache=True, nogil=True)
def _write_node(parts, at, value, mask):
    parts[at].value, parts[at].mask = value, mask
    return at + 1


@njit(cache=True, nogil=True)
def _write_words(stored, slots, threshold, parts, starts, tops):
    """Write each block's inner nodes in preorder, and its top, in which log-odds are 1 (occupied) or 0."""
    values, masks = np.empty(_PYRAMID, float32), np.zeros(_PYRAMID, uint8)
    at = 0
    for b in range(len(slots)):
        block = stored[slots[b]]
        for i in range(BLOCK_VOXELS):
            state = float32(1.0) if block[i] >= threshold else float32(0.0)
            values[i] = state if block[i] == block[i] else block[i]
        _raise_pyramid(values, masks)
        tops[b].value, tops[b].mask = values[_TOP], masks[_TOP]
        if masks[_TOP]:
            at = _write_word(parts, at, values, masks, _QUADS)
            for quad in range(8):
                if masks[_QUADS + quad]:
                    at = _write_word(parts, at, values, masks, _PAIRS + 8 * quad)
                    for pair in range(8 * quad, 8 * quad + 8):
                        if masks[_PAIRS + pair]:
                            at = _write_word(parts, at, values, masks, 8 * pair)
        starts[b + 1] = at


@njit(cache=True, nogil=True)
def _write_word(parts, at, values, masks, first):
    """Write the word of the parent of eight nodes."""
    word = 0
    for i in range(8):
        value = values[first + i]
        leaf = int64(value == value) * (_OCCUPIED if value > 0 else _FREE)
        word |= (_INNER if masks[first + i] else leaf) << (2 * i)
    parts[at] = uint16(word)
    return at + 1


@njit(cache=True, nogil=True)
def _parents(codes, nodes, offset):
    """Return (codes, nodes, first_children) of the level above nodes in Morton order.

    Args:
        codes: (N,) int64 Morton codes at the nodes' own depth.
        nodes: (N,) NODE.
        offset: Index of the first of them among all upper nodes.
    """
    n = len(codes)
    up_codes, first_children, up_nodes = np.empty(n, int64), np.empty(n, int64), np.empty_like(nodes)
    values, masks = np.empty(8, float32), np.zeros(8, uint8)
    count, i = 0, 0
    while i < n:
        up_codes[count], first_children[count] = codes[i] >> 3, offset + i
        values[:], masks[:] = np.nan, 0
        while i < n and codes[i] >> 3 == up_codes[count]:
            values[codes[i] & 7], masks[codes[i] & 7] = nodes[i].value, nodes[i].mask
            i += 1
        value, mask = _join(values, masks, 0)
        count = _write_node(up_nodes, count, value, mask)
    return up_codes[:count], up_nodes[:count], first_children[:count]


@njit(cache=True, nogil=True)
def _assemble_nodes(upper, order, parts, starts, payload):
    """Write the nodes of an order, given the parts of its blocks one after the other."""
    block, at = 0, 0
    for node in order:
        if node < len(upper.starts) - 1:
            at = _copy_part(starts, block, parts, payload, at)
            block += 1
        else:
            payload[at] = upper.nodes[node]
            at += 1


@njit(cache=True, nogil=True)
def _assemble_words(upper, parts, payload):
    """Write the words of all inner nodes in preorder; return their number."""
    blocks, at = len(upper.starts) - 1, 0
    values, masks = np.empty(8, float32), np.empty(8, uint8)
    for node in preorder(upper):
        if node < blocks:
            at = _copy_part(upper.starts, node, parts, payload, at)
        elif upper.nodes[node].mask:
            at = _write_upper_word(upper, node, payload, at, values, masks)
    return at


@njit(cache=True, nogil=True)
def _copy_part(starts, block, parts, payload, at):
    for i in range(starts[block], starts[block + 1]):
        payload[at] = parts[i]
        at += 1
    return at


@njit(cache=True, nogil=True)
def _write_upper_word(upper, node, payload, at, values, masks):
    """Write the word of a node above the blocks; ``values`` and ``masks`` (8,) are scratch."""
    values[:], masks[:] = np.nan, 0
    child = upper.first_children[node]
    for i in range(8):
        if (upper.nodes[node].mask >> i) & 1:
            values[i], masks[i] = upper.nodes[child].value, upper.nodes[child].mask
            child += 1
    return _write_word(payload, at, values, masks, 0)


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
