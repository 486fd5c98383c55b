"""OctoMap files of a merged map, written from the tiles' pieces one after the other.

Tiles stand in Morton order, and OctoMap's files list nodes in preorder: between the pieces there are only the
few nodes above the tiles. The bytes are those of the whole map written in one piece.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.merging.jobs import JoinedTile, Workspace
from mapper.octree.attributes import UNSET
from mapper.octree.color_tree import COLOR_NODE, parent_color
from mapper.octree.octomap_file import LEAF_ROOT, write_tree
from mapper.octree.octomap_tree import NODE, UpperNodes, children_in, preorder, upper_nodes, word_of

Tiles = Mapping[int, JoinedTile]


def write_whole_ot(path: Path, workspace: Workspace, tiles: Tiles) -> None:
    """Write the log-odds of all tiles as one ``.ot`` file; atomic.

    Args:
        path: File to write.
        workspace: Files of the merge, with the tiles' pieces.
        tiles: Results of the tiles, in Morton order.
    """
    ordered = list(tiles)
    upper = _upper(workspace, tiles, [joined.top for joined in tiles.values()])
    visited = preorder(upper).tolist()
    colors = _colors(upper, tiles) if workspace.has_colors else None

    def payload() -> Iterator[NDArray[np.generic]]:
        for node in visited:
            if node < len(tiles):
                yield np.fromfile(workspace.piece(ordered[node], "ot"), np.uint8)
            elif colors is None:
                yield upper.nodes[node : node + 1]
            else:
                record = np.zeros(1, COLOR_NODE)
                record["value"], record["mask"] = upper.nodes[node]["value"], upper.nodes[node]["mask"]
                record["rgb"] = colors[node]
                yield record

    write_tree(
        path,
        payload(),
        binary=False,
        node_count=sum(tiles[ordered[node]].nodes if node < len(tiles) else 1 for node in visited),
        resolution_m=workspace.tiling.resolution_m,
        tree_name="ColorOcTree" if workspace.has_colors else "OcTree",
    )


def write_whole_bt(path: Path, workspace: Workspace, tiles: Tiles) -> None:
    """Write all tiles, each voxel free or occupied, as one ``.bt`` file; atomic."""
    ordered = list(tiles)
    upper = _upper(workspace, tiles, [joined.state for joined in tiles.values()])
    visited = preorder(upper).tolist()
    words = {
        node: word_of(upper, node) for node in visited if node >= len(tiles) and upper.nodes[node]["mask"]
    }
    children = sum(children_in(word) for word in words.values())
    children += sum(tiles[ordered[node]].children for node in visited if node < len(tiles))

    def payload() -> Iterator[NDArray[np.generic]]:
        for node in visited:
            if node < len(tiles):
                yield np.fromfile(workspace.piece(ordered[node], "bt"), np.uint8)
            elif node in words:
                yield words[node].astype("<u2", copy=False)
        if not children:
            yield LEAF_ROOT

    write_tree(
        path, payload(), binary=True, node_count=1 + children, resolution_m=workspace.tiling.resolution_m
    )


def _upper(workspace: Workspace, tiles: Tiles, tops: list[tuple[float, int]]) -> UpperNodes:
    codes = np.fromiter(tiles, np.int64, len(tiles))
    return upper_nodes(codes, np.array(tops, NODE), np.arange(len(tiles) + 1), levels=workspace.tiling.depth)


def _colors(upper: UpperNodes, tiles: Tiles) -> NDArray[np.uint8]:
    """Return the (M, 3) colours of the nodes down to the tops of tiles, children before their parents."""
    colors = np.full((len(upper.nodes), 3), UNSET, np.uint8)
    colors[: len(tiles)] = [joined.color for joined in tiles.values()]
    firsts = upper.first_children[len(tiles) :]
    ends = [*firsts[1:], len(upper.nodes) - 1]
    for node, (first, end) in enumerate(zip(firsts, ends, strict=True), start=len(tiles)):
        children = np.full((8, 3), UNSET, np.uint8)
        children[: end - first] = colors[first:end]  # a pruned node had all eight, so places do not matter
        colors[node] = parent_color(children, pruned=upper.nodes[node]["mask"] == 0)
    return colors
