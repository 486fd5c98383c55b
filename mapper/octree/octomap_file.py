"""OctoMap's files: ``.bt`` (free or occupied) and ``.ot`` (log-odds), byte for byte as the C++ library's."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import MapFileError
from mapper.octree import tree_reader
from mapper.octree.attributes import UNSET
from mapper.octree.color_tree import COLOR_NODE, colored
from mapper.octree.keys import KEY_BITS
from mapper.octree.sensor_model import SensorModel
from mapper.octree.tree import NODE, children_in, nodes_in_preorder, preorder_of, words_in_preorder
from mapper.runtime import atomic

if TYPE_CHECKING:
    from mapper.octree.map import OctreeMap

_FULL = b"# Octomap OcTree file"
_BINARY = b"# Octomap OcTree binary file"
LEAF_ROOT = np.zeros(1, "<u2")
"""The one word of a ``.bt`` file whose root is a leaf."""
_TREE_NAMES = {"OcTree": "OcTree", "1": "OcTree", "ColorOcTree": "ColorOcTree"}

_FAULTS = {
    tree_reader.CUT_SHORT: "ends before its tree does; it is truncated",
    tree_reader.TRAILING: "goes on after its tree has ended; it is damaged",
    tree_reader.TOO_DEEP: f"has nodes deeper than {KEY_BITS} levels; it is damaged",
    tree_reader.CHILDLESS: "has an inner node without children; it is damaged",
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
    if len(octree) and octree.attributes is not None and octree.attributes.has_colors:
        nodes = colored(nodes_in_preorder(octree.blocks), octree.blocks, octree.attributes)
        pieces, count, tree_name = [nodes], len(nodes), "ColorOcTree"
    elif len(octree):
        tree = preorder_of(octree.blocks)
        pieces, count = tree.pieces(), tree.count
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
    words, node_count = _bt_words(octree)
    write_tree(path, [words], binary=True, node_count=node_count, resolution_m=octree.resolution_m)


def bt_bytes(octree: "OctreeMap") -> int:
    """Return the size of the file that :func:`write_bt` writes."""
    words, node_count = _bt_words(octree)
    return len(_header_bytes(_BINARY, node_count, octree.resolution_m, "OcTree")) + words.nbytes


def _bt_words(octree: "OctreeMap") -> tuple[NDArray[np.uint16], int]:
    """Return the words of a ``.bt`` file and the number of nodes that they describe."""
    if not len(octree):
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


@dataclass(frozen=True, slots=True, eq=False)
class OctomapTree:
    """Content of an OctoMap file.

    Attributes:
        resolution_m: Edge of a voxel.
        leaves: Leaves of the pruned tree; None of an empty tree.
        colors: (L, 3) uint8 colours of the leaves, white where there are none; None of a ``.bt`` file.
    """

    resolution_m: float
    leaves: tree_reader.TreeLeaves | None = None
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


def _binary_leaves(
    path: Path, header: _Header, payload: memoryview, sensor: SensorModel
) -> tree_reader.TreeLeaves:
    # A word describes at most eight nodes, which bounds the memory that a damaged count can claim.
    if len(payload) % 2 or header.node_count > 1 + 4 * len(payload):
        raise MapFileError(
            f"{path}: {len(payload)} bytes cannot hold {header.node_count} nodes; it is truncated"
        )
    leaves: tree_reader.TreeLeaves
    leaves, nodes, fault = tree_reader.leaves_of_words(
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


def _full_leaves(
    path: Path, header: _Header, payload: memoryview
) -> tuple[tree_reader.TreeLeaves, NDArray[np.uint8]]:
    """Return the leaves and their (L, 3) uint8 colours, white where there are none."""
    record = COLOR_NODE if header.tree_name == "ColorOcTree" else NODE
    if len(payload) != header.node_count * record.itemsize:
        raise MapFileError(
            f"{path}: the header promises {header.node_count} nodes of {record.itemsize} bytes, "
            f"but {len(payload)} bytes follow"
        )
    nodes = np.frombuffer(payload, dtype=record)
    values: NDArray[np.float32] = np.ascontiguousarray(nodes["value"], dtype=np.float32)
    leaves: tree_reader.TreeLeaves
    leaves, fault = tree_reader.leaves_of_nodes(values, np.ascontiguousarray(nodes["mask"]))
    if fault:
        raise MapFileError(f"{path}: {_FAULTS[fault]}")
    if not np.isfinite(leaves.values).all():
        raise MapFileError(f"{path}: has leaves whose log-odds are not finite; it is damaged")
    if record is NODE:
        return leaves, np.full((len(leaves.codes), 3), UNSET, np.uint8)
    return leaves, nodes["rgb"][nodes["mask"] == 0]
