"""The jobs of a merge: a run cut into tiles, a tile summed, a column of tiles looked at from above.

Each reads files, writes files and returns a few numbers, so it can be done on any machine that sees them. A
job that is done again writes the same files again.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from mapper.core.config import Config
from mapper.core.geometry import Transform, inverse
from mapper.merging.merged_map import TILES
from mapper.merging.tiling import Tiling
from mapper.octree.attributes import UNSET
from mapper.octree.color_tree import colored
from mapper.octree.config import OctreeConfig, SliceConfig
from mapper.octree.ground_height import GroundHeights, lowest_occupied
from mapper.octree.map import OctreeMap
from mapper.octree.map_file import write_map
from mapper.octree.octomap_file import read_map
from mapper.octree.resampling import blocks_reached, resampled
from mapper.octree.slice import block_extent, see_band
from mapper.octree.summing import Overlap
from mapper.octree.tree import children_in, nodes_in_preorder, words_in_preorder
from mapper.runtime.atomic import atomic_file, write_bytes
from mapper.runtime.timing import peak_memory_mb


@dataclass(frozen=True, slots=True)
class Site:
    """Where a merge works, and what its jobs share.

    Attributes:
        folder: The map that is being made.
        scratch: What is thrown away at the end.
        tiling: How the map is cut.
        config: The map's.
    """

    folder: Path
    scratch: Path
    tiling: Tiling
    config: OctreeConfig

    def part(self, tile: int, run: int) -> Path:
        """Return the file of what a run knows of a tile."""
        return self.parts(tile) / f"{run:04d}.octree"

    def parts(self, tile: int) -> Path:
        """Return the folder of what the runs know of a tile."""
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


class Effort(Config):
    """What a job took."""

    seconds: float
    """Wall time."""
    peak_memory_mb: float
    """Of its process, since that began."""


class SplitRun(Config):
    """What became of a run."""

    part_bytes: dict[int, int]
    """Size of the file of each tile that it knows something of."""
    voxels: int
    """Known ones, in the run's own map."""
    has_colors: bool
    effort: Effort


class JoinedTile(Config):
    """What became of a tile."""

    voxels: int
    """Known ones."""
    first: tuple[int, int]
    """x and y key of the first column of its blocks."""
    last: tuple[int, int]
    """Just after the last column."""
    overlaps: tuple[Overlap, ...]
    """Of each run that knows something here, with the sum of those before."""
    top: tuple[float, int]
    """Log-odds and mask of the tile's top in the ``.ot`` file."""
    color: tuple[int, int, int]
    """Of the top, if the map has colours."""
    nodes: int
    """In the ``.ot`` file, the top included."""
    state: tuple[float, int]
    """Value and mask of the top in the ``.bt`` file."""
    children: int
    """Nodes below the top in the ``.bt`` file."""
    effort: Effort


class SeenColumn(Config):
    """What became of a column of tiles."""

    known_columns: int
    """Columns of voxels in which anything is known."""
    effort: Effort


def split_run(site: Site, run: int, path: Path, T_map_world: Transform | None) -> SplitRun:
    """Write what a run knows of each tile as a file of its own.

    Args:
        site: Where.
        run: Its place in the list.
        path: Its map.
        T_map_world: (4, 4) where its world lies; None is where the map's does.
    """
    began = perf_counter()
    octree = read_map(path)
    part_bytes: dict[int, int] = {}
    has_colors = False
    for tile, part in _parts(site, octree, T_map_world):
        write_map(site.part(tile, run), part)
        part_bytes[tile] = site.part(tile, run).stat().st_size
        has_colors |= part.attributes is not None and part.attributes.has_colors
    return SplitRun(part_bytes=part_bytes, voxels=len(octree), has_colors=has_colors, effort=_effort(began))


def _parts(site: Site, octree: OctreeMap, T_map_world: Transform | None) -> Iterator[tuple[int, OctreeMap]]:
    if T_map_world is None:
        slots = octree.blocks.sorted_slots()
        for tile, some in _by_tile(site.tiling, octree.blocks.codes[slots]):
            part = OctreeMap(site.config)
            part.add(octree, slots=slots[some])
            yield tile, part
    else:
        codes = blocks_reached(octree, T_map_world)
        for tile, some in _by_tile(site.tiling, codes):
            part = resampled(octree, inverse(T_map_world), codes[some], site.config)
            if len(part):
                yield tile, part


def _by_tile(tiling: Tiling, codes: NDArray[np.int64]) -> Iterator[tuple[int, slice]]:
    """Yield each tile and where its blocks stand in increasing codes."""
    tiles, starts = np.unique(tiling.tiles_of(codes), return_index=True)
    ends = np.append(starts, len(codes))[1:]
    for tile, start, end in zip(tiles.tolist(), starts, ends, strict=True):
        yield tile, slice(start, end)


def join_tile(
    site: Site, tile: int, runs: Sequence[int], *, has_colors: bool, follows_ground: bool
) -> JoinedTile:
    """Sum what the runs know of a tile, and write the tile and its pieces of the OctoMap files.

    Args:
        site: Where.
        tile: Which.
        runs: Places in the list of those that know something here.
        has_colors: Whether the map has any.
        follows_ground: Whether the slice's band does.
    """
    began = perf_counter()
    octree = OctreeMap(site.config)
    overlaps = tuple(octree.add(read_map(site.part(tile, run))) for run in runs)
    octree.clamp()
    write_map(site.tile(tile), octree)
    depth = site.tiling.depth
    nodes = nodes_in_preorder(octree.blocks, root_depth=depth)
    color = (UNSET, UNSET, UNSET)
    if has_colors and octree.attributes is not None:
        nodes = colored(nodes, octree.blocks, octree.attributes, root_depth=depth, root_code=tile)
        color = tuple(nodes["rgb"][0].tolist())
    words, state = words_in_preorder(octree.blocks, octree.occupied_log_odds, root_depth=depth)
    write_bytes(site.piece(tile, "ot"), nodes.tobytes())
    write_bytes(site.piece(tile, "bt"), words.astype("<u2", copy=False).tobytes())
    if follows_ground:
        first, shape = site.window(tile)
        _save(site.piece(tile, "lowest"), lowest_occupied(octree, first=first, shape=shape))
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
        effort=_effort(began),
    )


def see_column(
    site: Site, tiles: Sequence[int], config: SliceConfig, *, ground: Path | None, floor_z_m: float
) -> SeenColumn:
    """Look from above at tiles that lie over each other, and write what the slice's band shows there.

    Args:
        site: Where.
        tiles: Which, from below.
        config: The band.
        ground: File of what the band follows; None if it is level.
        floor_z_m: Height of the floor in the map.
    """
    began = perf_counter()
    first, shape = site.window(tiles[0])
    followed = None if ground is None else load_ground(ground)
    seen, known = np.zeros(shape, np.uint8), np.zeros(shape, np.bool_)
    for tile in tiles:
        octree = read_map(site.tile(tile))
        seen |= see_band(octree, config, first=first, shape=shape, ground=followed, floor_z_m=floor_z_m)
        x, y = (octree.leaves().keys[:, :2] - first).T
        known[y, x] = True
    _save(site.piece(tiles[0], "seen"), seen)
    return SeenColumn(known_columns=int(np.count_nonzero(known)), effort=_effort(began))


def save_ground(path: Path, ground: GroundHeights) -> None:
    """Write the ground for the jobs that follow it."""
    with atomic_file(path) as part, part.open("wb") as file:
        np.savez(file, heights_m=ground.heights_m, first=ground.first, columns=ground.columns)


def load_ground(path: Path) -> GroundHeights:
    """Return what ``save_ground`` wrote."""
    with np.load(path) as arrays:
        return GroundHeights(arrays["heights_m"], arrays["first"], int(arrays["columns"]))


def _save(path: Path, array: NDArray[np.generic]) -> None:
    with atomic_file(path) as part, part.open("wb") as file:
        np.save(file, array)


def _effort(began: float) -> Effort:
    return Effort(seconds=perf_counter() - began, peak_memory_mb=peak_memory_mb())
