"""OctoMap's files: ``.bt`` (free or occupied) and ``.ot`` (log-odds), byte for byte as the C++ library's."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit
from numpy import float32, int64, uint8
from numpy.typing import NDArray

from mapper.core.errors import MapFileError
from mapper.octree.attributes import UNSET
from mapper.octree.color_tree import COLOR_NODE, color_nodes
from mapper.octree.keys import BLOCK_BITS, BLOCK_DEPTH, BLOCK_VOXELS, KEY_BITS
from mapper.octree.octomap_tree import (
    NODE,
    children_in,
    enter_next_child,
    nodes_in_preorder,
    preorder_of,
    words_in_preorder,
)
from mapper.octree.sparse_grid import BLOCK_BYTES, BlockStore, SensorModel, check_memory
from mapper.runtime import atomic

if TYPE_CHECKING:
    from mapper.octree.map import OctreeMap

WHOLE, CUT_SHORT, TRAILING, TOO_DEEP, CHILDLESS = range(5)
"""Verdicts on the records of a file: a whole tree, or the fault that was found."""

_FULL = b"# Octomap OcTree file"
_BINARY = b"# Octomap OcTree binary file"
LEAF_ROOT = np.zeros(1, "<u2")
"""The one word of a ``.bt`` file whose root is a leaf."""
_TREE_NAMES = {"OcTree": "OcTree", "1": "OcTree", "ColorOcTree": "ColorOcTree"}

_FAULTS = {
    CUT_SHORT: "ends before its tree does; it is truncated",
    TRAILING: "goes on after its tree has ended; it is damaged",
    TOO_DEEP: f"has nodes deeper than {KEY_BITS} levels; it is damaged",
    CHILDLESS: "has an inner node without children; it is damaged",
}


@dataclass(frozen=True, slots=True)
class _Header:
    binary: bool
    tree_name: str
    node_count: int
    resolution_m: float


def write_ot(path: Path, octree: "OctreeMap") -> None:
    """Write all log-odds as an OcTree, pruned, or as a ColorOcTree if the map has colours; atomic."""
    pieces: Iterable[NDArray[np.void]] = ()
    count, tree_name = 0, "OcTree"
    if len(octree.blocks) and octree.attributes is not None and octree.attributes.has_colors:
        nodes = color_nodes(nodes_in_preorder(octree.blocks), octree.blocks, octree.attributes)
        pieces, count, tree_name = [nodes], len(nodes), "ColorOcTree"
    elif len(octree.blocks):
        count, pieces = preorder_of(octree.blocks)
    write_tree(
        path,
        pieces,
        binary=False,
        node_count=count,
        resolution_m=octree.resolution_m,
        tree_name=tree_name,
    )


def write_bt(path: Path, octree: "OctreeMap") -> None:
    """Write the maximum-likelihood map (each voxel free or occupied) as an OcTree, pruned; atomic."""
    words, node_count = bt_words(octree)
    write_tree(path, [words], binary=True, node_count=node_count, resolution_m=octree.resolution_m)


def bt_bytes(octree: "OctreeMap") -> int:
    """Return the size of the file that :func:`write_bt` writes."""
    words, node_count = bt_words(octree)
    return len(_header_bytes(_BINARY, node_count, octree.resolution_m, "OcTree")) + words.nbytes


def bt_words(octree: "OctreeMap") -> tuple[NDArray[np.uint16], int]:
    """Return the (W,) words that follow the header of a ``.bt`` file, and how many nodes they describe."""
    if not len(octree.blocks):
        return np.empty(0, "<u2"), 0
    words, _ = words_in_preorder(octree.blocks, octree.occupied_log_odds)
    words = words if len(words) else LEAF_ROOT
    return words.astype("<u2", copy=False), 1 + children_in(words)


def write_tree(
    path: Path,
    payload: Iterable[NDArray[np.generic]],
    *,
    binary: bool,
    node_count: int,
    resolution_m: float,
    tree_name: str = "OcTree",
) -> None:
    """Write a tree from its encoded nodes; atomic.

    Args:
        path: File to write.
        payload: Bytes after the header, piece by piece, so that a tree need not fit into memory.
        binary: A ``.bt`` file, of words; otherwise an ``.ot`` file, of nodes.
        node_count: Number of nodes that the payload describes.
        resolution_m: Edge of a voxel.
        tree_name: OctoMap's name for the kind of tree.
    """
    with atomic.atomic_file(path) as part, part.open("wb") as file:
        file.write(_header_bytes(_BINARY if binary else _FULL, node_count, resolution_m, tree_name))
        for piece in payload:
            file.write(piece.data)


def _header_bytes(first_line: bytes, node_count: int, resolution_m: float, tree_name: str) -> bytes:
    return first_line + (
        "\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
        f"id {tree_name}\nsize {node_count}\nres {resolution_m:g}\ndata\n"
    ).encode("ascii")


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


@dataclass(frozen=True, slots=True, eq=False)
class OctomapTree:
    """Content of an OctoMap file.

    Attributes:
        resolution_m: Edge of a voxel.
        leaves: Leaves of the pruned tree; None of an empty tree.
        colors: (L, 3) uint8 colours of the leaves, white where there are none; None of a ``.bt`` file.
    """

    resolution_m: float
    leaves: TreeLeaves | None = None
    colors: NDArray[np.uint8] | None = None


def parse_tree(path: Path, data: bytes, sensor: SensorModel) -> OctomapTree:
    """Return the tree of a file's bytes.

    Args:
        path: Path of the file, for errors.
        data: All of its bytes.
        sensor: Its limits are the log-odds of the leaves of a ``.bt`` file.

    Raises:
        MapFileError: The file is truncated, foreign or damaged.
    """
    header, start = _parse_header(path, data)
    if header.node_count == 0:
        if start != len(data):
            raise MapFileError(f"{path}: size 0, but {len(data) - start} bytes follow; it is damaged")
        return OctomapTree(header.resolution_m)
    payload = memoryview(data)[start:]
    if header.binary:
        return OctomapTree(header.resolution_m, _binary_leaves(path, header, payload, sensor))
    return OctomapTree(header.resolution_m, *_full_leaves(path, header, payload))


def _parse_header(path: Path, data: bytes) -> tuple[_Header, int]:
    """Return the header and the start of the payload; keys come in any order, unknown ones are skipped."""
    first_line, _, _ = data.partition(b"\n")
    binary = first_line.startswith(_BINARY)
    if not binary and not first_line.startswith(_FULL):
        what = "it is empty" if not data else f"it starts with {first_line[:32]!r}"
        raise MapFileError(
            f"{path}: not an OctoMap file: {what}, want {_FULL.decode()!r} or {_BINARY.decode()!r}"
        )
    fields: dict[str, str] = {}
    start = len(first_line) + 1
    while True:
        end = data.find(b"\n", start)
        if end < 0:
            raise MapFileError(f"{path}: the header has no line 'data'; the file is truncated")
        line = data[start:end].decode("ascii", errors="replace").strip()
        start = end + 1
        if line == "data":
            break
        name, _, value = line.partition(" ")
        if name and not name.startswith("#"):
            fields[name] = value.strip()
    for name in ("id", "size", "res"):
        if name not in fields:
            raise MapFileError(f"{path}: the header has no line {name!r}; the file is damaged")
    if fields["id"] not in _TREE_NAMES:
        raise MapFileError(f"{path}: holds a {fields['id'][:32]!r}; only OcTree and ColorOcTree can be read")
    node_count = int(fields["size"]) if fields["size"].isdecimal() else -1
    try:
        resolution_m = float(fields["res"])
    except ValueError:
        resolution_m = -1.0
    if node_count < 0 or not 0.0 < resolution_m < np.inf:
        raise MapFileError(
            f"{path}: size {fields['size'][:32]!r} must be a count, res {fields['res'][:32]!r} a length > 0 m"
        )
    return _Header(binary, _TREE_NAMES[fields["id"]], node_count, resolution_m), start


def _binary_leaves(path: Path, header: _Header, payload: memoryview, sensor: SensorModel) -> TreeLeaves:
    # A word describes at most eight nodes, which bounds the memory that a damaged count can claim.
    if len(payload) % 2 or header.node_count > 1 + 4 * len(payload):
        raise MapFileError(
            f"{path}: {len(payload)} bytes cannot hold {header.node_count} nodes; it is truncated"
        )
    leaves: TreeLeaves
    leaves, nodes, fault = leaves_of_words(
        np.frombuffer(payload, dtype="<u2"),
        header.node_count,
        sensor.lowest,
        sensor.highest,
    )
    if fault:
        raise MapFileError(f"{path}: {_FAULTS[fault]}")
    if nodes != header.node_count:
        more = "more" if nodes > header.node_count else f"{nodes}"
        raise MapFileError(f"{path}: the header promises {header.node_count} nodes, the tree has {more}")
    return leaves


def _full_leaves(path: Path, header: _Header, payload: memoryview) -> tuple[TreeLeaves, NDArray[np.uint8]]:
    """Return the leaves and their (L, 3) uint8 colours, white where there are none."""
    record = COLOR_NODE if header.tree_name == "ColorOcTree" else NODE
    if len(payload) != header.node_count * record.itemsize:
        raise MapFileError(
            f"{path}: the header promises {header.node_count} nodes of {record.itemsize} bytes, "
            f"but {len(payload)} bytes follow"
        )
    nodes = np.frombuffer(payload, dtype=record)
    values: NDArray[np.float32] = np.ascontiguousarray(nodes["value"], dtype=np.float32)
    leaves: TreeLeaves
    leaves, fault = leaves_of_nodes(values, np.ascontiguousarray(nodes["mask"]))
    if fault:
        raise MapFileError(f"{path}: {_FAULTS[fault]}")
    if not np.isfinite(leaves.values).all():
        raise MapFileError(f"{path}: has leaves whose log-odds are not finite; it is damaged")
    if record is NODE:
        return leaves, np.full((len(leaves.codes), 3), UNSET, np.uint8)
    return leaves, nodes["rgb"][nodes["mask"] == 0]


def fill(store: BlockStore, leaves: TreeLeaves) -> None:
    """Write leaves into an empty store at the finest level.

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
