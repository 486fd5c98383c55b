"""Jobs of a merge: fuse a run that has moved, cut its map into tiles, sum a tile, slice a column of tiles.

Each reads files, writes files and returns a few numbers, so it can run on any machine that sees them. A job
that is run again writes the same files again.

Each tile has its pieces of the map's OctoMap files. Tiles stand in Morton order, and these files list nodes
in preorder: between the pieces there are only the few nodes above the tiles. The bytes are those of the whole
map written in one piece.
"""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.core.config import Config
from mapper.core.geometry import Transform, inverse
from mapper.core.trajectory import Trajectory
from mapper.mapping.config import edits_of
from mapper.mapping.map_building import build_octree
from mapper.merging.merged_map import TILES, Tiling
from mapper.octree.attributes import UNSET
from mapper.octree.color_tree import COLOR_NODE, color_nodes, parent_color
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap, read_octree
from mapper.octree.map_file import write_map
from mapper.octree.occupied_columns import block_extent, lowest_occupied, occupied_voxels
from mapper.octree.octomap_file import LEAF_ROOT, write_tree
from mapper.octree.octomap_tree import (
    NODE,
    UpperNodes,
    children_in,
    nodes_in_preorder,
    preorder,
    upper_nodes,
    word_of,
    words_in_preorder,
)
from mapper.octree.resampling import blocks_reached, resample
from mapper.octree.scan_updates import ScanUpdateWriter, open_scan_updates
from mapper.octree.slice import Band
from mapper.octree.sparse_grid import Overlap
from mapper.run.folder import open_run
from mapper.runtime.atomic import atomic_file, write_bytes
from mapper.runtime.progress import SILENT

OCCUPIED, LOWEST, BAND, GROUND = "occupied", "lowest", "band", "ground"
"""Pieces that are written of a tile: its occupied voxels and the lowest of each column; and of a column of
tiles: the slice's band and the ground below it."""


def stays_within_m(config: OctreeConfig) -> float:
    """Return how far the ends of a frame's rays may move before it is fused again: half a voxel."""
    return 0.5 * config.resolution_m


@dataclass(frozen=True, slots=True)
class Workspace:
    """Files of a merge and what its jobs share.

    Attributes:
        folder: The map that is being made.
        scratch: Folder that is removed at the end.
        tiling: Tiling of the map.
        config: Settings of the map's octree.
        follows_ground: Whether the slice's band follows the ground.
        has_colors: Whether the map has colours, which is known once all runs are cut into tiles.
    """

    folder: Path
    scratch: Path
    tiling: Tiling
    config: OctreeConfig
    follows_ground: bool
    has_colors: bool = False

    def part(self, tile: int, run: int) -> Path:
        """Return the file of a run's part of a tile."""
        return self.parts(tile) / f"{run:04d}.octree"

    def parts(self, tile: int) -> Path:
        """Return the folder of the runs' parts of a tile."""
        return self.scratch / "parts" / self.tiling.name_of(tile)

    def tile(self, tile: int) -> Path:
        """Return the file of a finished tile."""
        return self.folder / TILES / f"{self.tiling.name_of(tile)}.octree"

    def piece(self, tile: int, ending: str) -> Path:
        """Return the file of a tile's piece of something larger."""
        return self.scratch / "pieces" / f"{self.tiling.name_of(tile)}.{ending}"

    def window(self, tile: int) -> tuple[NDArray[np.int64], tuple[int, int]]:
        """Return the (2,) x and y keys of a tile's first column, and how many rows and columns it has."""
        return self.tiling.first_key(tile)[:2], (self.tiling.voxels, self.tiling.voxels)


class FusedRun(Config):
    """Result of fusing a run again."""

    voxels: int
    """Number of known voxels."""


class SplitRun(Config):
    """Result of cutting a run's map into tiles."""

    part_bytes: dict[int, int]
    """Size of the file of each tile in which the run has a known voxel."""
    voxels: int
    """Number of known voxels in the run's own map."""
    has_colors: bool


class JoinedTile(Config):
    """Result of summing a tile."""

    voxels: int
    """Number of known voxels."""
    first: tuple[int, int]
    """x and y key of the first column of its blocks."""
    last: tuple[int, int]
    """x and y key just after the last column of its blocks."""
    overlaps: tuple[Overlap, ...]
    """Overlap of each run with a known voxel in the tile with the sum of the runs before."""
    top: tuple[float, int]
    """Log-odds and mask of the tile's top in the ``.ot`` file."""
    color: tuple[int, int, int]
    """Colour of the top, if the map has colours."""
    nodes: int
    """Number of nodes in the ``.ot`` file, the top included."""
    state: tuple[float, int]
    """Value and mask of the top in the ``.bt`` file."""
    children: int
    """Number of nodes below the top in the ``.bt`` file."""


class SlicedColumn(Config):
    """Result of slicing a column of tiles."""

    known_columns: int
    """Number of columns of voxels in which anything is known."""


def fuse_run(workspace: Workspace, run: int, path: Path, trajectory: Trajectory, octree: Path) -> FusedRun:
    """Make a run's octree again along other poses, by its own settings and edits; the run stays as it is.

    Frames that have moved by no more than half a voxel keep their update.

    Args:
        workspace: Files of the merge.
        run: Number of the run in the merge.
        path: Folder of the run.
        trajectory: Poses in its own world of the frames to fuse.
        octree: File to write.
    """
    built = open_run(path)
    settings = built.fused_config
    within_m = stays_within_m(workspace.config)
    before, written = built.scan_updates(), workspace.scratch / f"{run:04d}.updates"
    written.parent.mkdir(parents=True, exist_ok=True)
    with (
        open_scan_updates(before, within_m=within_m) if before is not None else nullcontext() as known,
        ScanUpdateWriter(written, settings.octree) as updates,
    ):
        fused = build_octree(
            built.open_log(),
            trajectory,
            settings,
            progress=SILENT,
            cached=known,
            updates=updates,
            edits=edits_of(built.manifest.edits),
        )
    written.unlink()
    write_map(octree, fused)
    return FusedRun(voxels=len(fused))


def split_run(
    workspace: Workspace,
    run: int,
    path: Path,
    T_map_world: Transform | None,
    only: frozenset[int] | None = None,
) -> SplitRun:
    """Write a run's part of each tile as a file of its own.

    Args:
        workspace: Files of the merge.
        run: Number of the run in the merge.
        path: File of its octree.
        T_map_world: (4, 4) pose of its world in the map; None is the identity.
        only: Tiles to write; None is all.
    """
    octree = read_octree(path)
    part_bytes: dict[int, int] = {}
    has_colors = False
    for tile, part in _cut(workspace, octree, T_map_world, only):
        write_map(workspace.part(tile, run), part)
        part_bytes[tile] = workspace.part(tile, run).stat().st_size
        has_colors |= part.attributes is not None and part.attributes.has_colors
    return SplitRun(part_bytes=part_bytes, voxels=len(octree), has_colors=has_colors)


def _cut(
    workspace: Workspace, octree: OctreeMap, T_map_world: Transform | None, only: frozenset[int] | None
) -> Iterator[tuple[int, OctreeMap]]:
    if T_map_world is None:
        slots = octree.blocks.sorted_slots()
        for tile, some in _slices_by_tile(workspace.tiling, octree.blocks.codes[slots], only):
            part = OctreeMap(workspace.config)
            part.add(octree, slots=slots[some])
            yield tile, part
    else:
        codes = blocks_reached(octree, T_map_world)
        for tile, some in _slices_by_tile(workspace.tiling, codes, only):
            part = resample(octree, inverse(T_map_world), codes[some], workspace.config)
            if len(part):
                yield tile, part


def _slices_by_tile(
    tiling: Tiling, codes: NDArray[np.int64], only: frozenset[int] | None
) -> Iterator[tuple[int, slice]]:
    """Yield each wanted tile and the slice of its blocks in increasing codes."""
    tiles, starts = np.unique(tiling.tiles_of(codes), return_index=True)
    ends = np.append(starts, len(codes))[1:]
    for tile, start, end in zip(tiles.tolist(), starts, ends, strict=True):
        if only is None or tile in only:
            yield tile, slice(start, end)


def join_tile(workspace: Workspace, tile: int, runs: Sequence[int]) -> JoinedTile:
    """Sum the runs' parts of a tile, and write the tile and its pieces of the OctoMap files.

    Args:
        workspace: Files of the merge.
        tile: Code of the tile.
        runs: Numbers of the runs with a known voxel in the tile.
    """
    octree = OctreeMap(workspace.config)
    overlaps = tuple(octree.add(read_octree(workspace.part(tile, run))) for run in runs)
    octree.clamp()
    write_map(workspace.tile(tile), octree)
    return _describe(workspace, tile, octree, overlaps)


def keep_tile(workspace: Workspace, tile: int, known: Path, overlaps: Sequence[Overlap]) -> JoinedTile:
    """Take over a tile of an earlier map, and write its pieces of the OctoMap files.

    Args:
        workspace: Files of the merge.
        tile: Code of the tile.
        known: Its file in that map.
        overlaps: Overlaps of its runs in that map.
    """
    with atomic_file(workspace.tile(tile)) as part:
        shutil.copyfile(known, part)
    return _describe(workspace, tile, read_octree(workspace.tile(tile)), tuple(overlaps))


def _describe(
    workspace: Workspace, tile: int, octree: OctreeMap, overlaps: tuple[Overlap, ...]
) -> JoinedTile:
    depth = workspace.tiling.depth
    nodes = nodes_in_preorder(octree.blocks, root_depth=depth)
    color = (UNSET, UNSET, UNSET)
    if workspace.has_colors and octree.attributes is not None:
        nodes = color_nodes(nodes, octree.blocks, octree.attributes, root_depth=depth, root_code=tile)
        color = tuple(nodes["rgb"][0].tolist())
    words, state = words_in_preorder(octree.blocks, octree.occupied_log_odds, root_depth=depth)
    write_bytes(workspace.piece(tile, "ot"), nodes.tobytes())
    write_bytes(workspace.piece(tile, "bt"), words.astype("<u2", copy=False).tobytes())
    if workspace.follows_ground:
        first, shape = workspace.window(tile)
        save_array(workspace.piece(tile, LOWEST), lowest_occupied(octree, first=first, shape=shape))
    save_array(workspace.piece(tile, OCCUPIED), occupied_voxels(octree))
    first, last = block_extent(octree)
    return JoinedTile(
        voxels=len(octree),
        first=tuple(first.tolist()),
        last=tuple(last.tolist()),
        overlaps=overlaps,
        top=(float(nodes["value"][0]), int(nodes["mask"][0])),
        color=color,
        nodes=len(nodes),
        state=(float(state["value"]), int(state["mask"])),
        children=children_in(words),
    )


def slice_column(
    workspace: Workspace, tiles: Sequence[int], band: Band, *, ground: Path | None
) -> SlicedColumn:
    """Flatten the slice's band in tiles that lie over each other, and write the raster.

    Args:
        workspace: Files of the merge.
        tiles: Codes of the tiles, the lowest first.
        band: Heights that the slice shows.
        ground: File of the ground below the column of tiles, which the band follows; None if it is level.
    """
    first, shape = workspace.window(tiles[0])
    ground_m = None if ground is None else np.load(ground)
    seen, known = np.zeros(shape, np.uint8), np.zeros(shape, np.bool_)
    for tile in tiles:
        octree = read_octree(workspace.tile(tile))
        seen |= band.flags(octree, first=first, shape=shape, ground_m=ground_m)
        x, y = (octree.leaves().keys[:, :2] - first).T
        known[y, x] = True
    save_array(workspace.piece(tiles[0], BAND), seen)
    return SlicedColumn(known_columns=int(np.count_nonzero(known)))


def save_array(path: Path, array: NDArray[np.generic]) -> None:
    """Write an array as a ``.npy`` file; atomic."""
    with atomic_file(path) as part, part.open("wb") as file:
        np.save(file, array)


def write_whole_ot(path: Path, workspace: Workspace, tiles: Mapping[int, JoinedTile]) -> None:
    """Write the log-odds of all tiles as one ``.ot`` file; atomic.

    Args:
        path: File to write.
        workspace: Files of the merge, with the tiles' pieces.
        tiles: Results of the tiles, in Morton order.
    """
    ordered = list(tiles)
    upper = _nodes_above(workspace, tiles, [joined.top for joined in tiles.values()])
    visited = preorder(upper).tolist()
    colors = _colors_above(upper, tiles) if workspace.has_colors else None

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


def write_whole_bt(path: Path, workspace: Workspace, tiles: Mapping[int, JoinedTile]) -> None:
    """Write all tiles, each voxel free or occupied, as one ``.bt`` file; atomic."""
    ordered = list(tiles)
    upper = _nodes_above(workspace, tiles, [joined.state for joined in tiles.values()])
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


def _nodes_above(
    workspace: Workspace, tiles: Mapping[int, JoinedTile], tops: list[tuple[float, int]]
) -> UpperNodes:
    codes = np.fromiter(tiles, np.int64, len(tiles))
    return upper_nodes(codes, np.array(tops, NODE), np.arange(len(tiles) + 1), levels=workspace.tiling.depth)


def _colors_above(upper: UpperNodes, tiles: Mapping[int, JoinedTile]) -> NDArray[np.uint8]:
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
