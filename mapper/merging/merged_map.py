"""Merged map on disk: its manifest, its tiling, and the opening of all or a part of it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import log2
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

import mapper
from mapper.config.build import BuildConfig
from mapper.core.config import Config, drop_unknown
from mapper.core.errors import ConfigError, RunError
from mapper.core.geometry import Array
from mapper.core.trajectory import Trajectory
from mapper.graph.g2o import read_g2o
from mapper.graph.model import PoseGraph
from mapper.mapping.config import Region
from mapper.merging.multi_session_graph import Tie
from mapper.navigation.config import CostmapConfig, TraversableConfig
from mapper.octree.config import OctreeConfig, SliceConfig
from mapper.octree.grid import OccupancyGrid
from mapper.octree.keys import BLOCK_BITS, KEY_BITS, KEY_ZERO, keys_of
from mapper.octree.map import OctreeMap, read_octree
from mapper.run import files
from mapper.run.manifest import is_merged_map
from mapper.run.map_folder import MapFolder, has_grid, stored_grid
from mapper.runtime.atomic import MANIFEST_NAME, FolderKind, partial_of, write_text
from mapper.sources.trajectory_files import read_tum

TILES, RUNS, SCRATCH = "tiles", "runs", "work"
FUSED = "fused.tum"
"""File of the poses in a run's own world by which its map was fused again."""
MERGED_MAP = FolderKind(
    "a merged map",
    manifest_keys=frozenset({"status", "tile_m", "tiles"}),
    files=files.names_of("maps", "exported maps") | {files.GRAPH, files.LOOPS, TILES, RUNS, SCRATCH},
    kind="merged map",
)

Corner = tuple[float, float, float]


class RunInMap(Config):
    """A run that was merged."""

    path: str
    """Absolute path of the run's folder."""
    fingerprint: str
    """Fingerprint of the run's ``map.octree``."""
    T_map_world: tuple[tuple[float, ...], ...]
    """4 × 4 pose of the run's world in the map."""
    placed: str
    """Source of that pose."""
    folder: str = ""
    """Subfolder with its ``trajectory.tum``, the poses in the map of the frames that its maps are made from,
    and with ``map.octree`` and ``fused.tum`` if it was fused again."""
    first_node: int | None = None
    """Number of its node 0 in the joint graph; None without a joint graph."""
    moved_m: float = 0.0
    """Largest distance by which the joint graph moved a point of its map within its world."""
    fused_again: bool = False
    """Whether it was fused again because of that."""
    voxels: int = 0
    """Number of known voxels in its own map."""
    has_colors: bool = False
    """Whether any voxel of its map has a colour."""
    keepout: tuple[Region, ...] = ()
    """Its keep-out regions, in its own world."""
    shared_voxels: int = 0
    """Number of its voxels that are known in the sum of the runs before it as well."""
    agreement: float | None = None
    """Of the shared voxels that are occupied in either, the share that is occupied in both."""


class Tile(Config):
    """A cube of the map, with a map file of its own."""

    name: str
    """The path down the octree, a digit for the child taken at each depth; names the file."""
    lower_m: Corner
    upper_m: Corner
    voxels: int
    """Number of known voxels."""
    runs: tuple[int, ...]
    """Numbers of the runs with a known voxel in the tile, by their place in ``MapManifest.runs``."""
    overlaps: tuple[tuple[int, int, int], ...] = ()
    """Overlap of each of these runs with the sum of those before it: number of voxels that are known in both,
    occupied in both, and occupied in either."""


class MapManifest(Config):
    """``manifest.json`` of a merged map."""

    kind: Literal["merged map"] = "merged map"
    status: Literal["merging", "complete"]
    mapper_version: str = mapper.__version__
    octree: OctreeConfig
    slice: SliceConfig
    traversable: TraversableConfig = TraversableConfig()
    costmap: CostmapConfig = CostmapConfig()
    """Settings of the first run, as are those of slice and floor."""
    tile_m: float
    floor_z_m: float
    runs: tuple[RunInMap, ...]
    ties: tuple[Tie, ...] = ()
    """Loops between runs in the joint graph, by pair of runs."""
    left_out: Mapping[str, str] = {}
    """Reason why each of the other runs that were given is not in the map, by its path."""
    tiles: tuple[Tile, ...] = ()
    voxels: int = 0
    area_km2: float = 0.0
    """Area of the columns in which anything is known."""
    no_floor: str = ""
    """Why there is no traversable floor; empty if there is one."""
    notes: tuple[str, ...] = ()

    @property
    def summary(self) -> str:
        """Its size, in a line."""
        return (
            f"{self.voxels} voxels of {self.octree.resolution_m:g} m in {len(self.tiles)} tiles of "
            f"{self.tile_m:g} m, {1e6 * self.area_km2:.0f} m² seen from above"
        )

    def save(self, folder: Path) -> None:
        """Write the manifest atomically."""
        write_text(folder / MANIFEST_NAME, self.model_dump_json(indent=2) + "\n")


@dataclass(frozen=True, slots=True)
class Tiling:
    """The cubes that a map is cut into, nodes of its octree at one depth and in its order.

    Attributes:
        resolution_m: Edge of a voxel.
        levels: Levels of the octree below a tile's top: its edge is 2 to this power, in voxels.
    """

    resolution_m: float
    levels: int

    @property
    def depth(self) -> int:
        """Depth of the tiles' tops in the octree."""
        return KEY_BITS - self.levels

    @property
    def voxels(self) -> int:
        """Edge of a tile in voxels."""
        return 1 << self.levels

    @property
    def edge_m(self) -> float:
        """Edge of a tile."""
        return self.voxels * self.resolution_m

    def tiles_of(self, block_codes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the tile, a Morton code at the tiles' depth, of each of (B,) block codes."""
        return block_codes >> (3 * (self.levels - BLOCK_BITS))

    def name_of(self, tile: int) -> str:
        """Return the path down the octree: a digit 0 … 7 for the child taken at each depth."""
        return f"{tile:0{self.depth}o}"

    def tile_named(self, name: str) -> int:
        """Return the tile of a name."""
        return int(name, 8)

    def first_key(self, tile: int) -> NDArray[np.int64]:
        """Return the (3,) key of a tile's lowest voxel."""
        key: NDArray[np.int64] = keys_of(np.array([tile]))[0] << self.levels
        return key

    def lower_m(self, tile: int) -> Array:
        """Return the (3,) lower corner of a tile in the map, metres."""
        return (self.first_key(tile) - KEY_ZERO).astype(np.float64) * self.resolution_m


def tiling_for(resolution_m: float, tile_m: float) -> Tiling:
    """Return the tiling whose edge, a power of two in voxels, is nearest to a length by ratio.

    Raises:
        ConfigError: The length is shorter than a block or longer than half of what keys can number.
    """
    lowest_m, highest_m = (resolution_m * (1 << bits) for bits in (BLOCK_BITS, KEY_BITS - 1))
    if not lowest_m <= tile_m <= highest_m:
        raise ConfigError(
            f"tile edge {tile_m:g} m: want {lowest_m:g} to {highest_m:g} m at {resolution_m:g} m a voxel"
        )
    return Tiling(resolution_m, round(log2(tile_m / resolution_m)))


@dataclass(frozen=True, repr=False)
class MergedMap(MapFolder):
    """A merged map on disk.

    Attributes:
        path: Its folder.
        config: Settings of its maps: those of its first run.
        manifest: Its ``manifest.json``.
    """

    manifest: MapManifest
    _octree = files.OCTREE_OT

    def __repr__(self) -> str:
        return f"MergedMap({str(self.path)!r})"

    def trajectory(self, run: RunInMap) -> Trajectory:
        """Return the poses in the map of the frames that a run's maps are made from.

        Raises:
            RunError: Its file is missing.
        """
        path = self.path / run.folder / files.TRAJECTORY
        if not path.is_file():
            raise RunError(f"{self.path}: has no trajectory of {run.path}; merge again")
        return read_tum(path)

    @cached_property
    def traversable(self) -> OccupancyGrid:
        """Floor that a robot can drive on, of the storey on which the first run begins.

        Raises:
            RunError: There is none; the message says why, if the manifest does.
        """
        if not has_grid(self, files.TRAVERSABLE):
            why = self.manifest.no_floor or "merge again"
            raise RunError(f"{self.path}: has no {files.TRAVERSABLE}.yaml; {why}")
        return stored_grid(self, files.TRAVERSABLE)

    @property
    def graph(self) -> PoseGraph | None:
        """The pose graph of all runs at its solution; None if they were placed as rigid bodies."""
        path = self.path / files.GRAPH
        return read_g2o(path) if path.exists() else None

    def tile_path(self, tile: Tile) -> Path:
        """Return the file of a tile."""
        return self.path / TILES / f"{tile.name}.octree"

    def load(self, lower_m: Array, upper_m: Array) -> OctreeMap:
        """Return the map of all tiles that a box touches.

        Args:
            lower_m: (3,) lower corner in the map, metres.
            upper_m: (3,) upper corner.

        Raises:
            MapFileError: A tile is missing or damaged.
            MapSizeError: They would not fit into memory.
        """
        octree = OctreeMap(self.manifest.octree)
        for tile in self.manifest.tiles:
            if np.less_equal(tile.lower_m, upper_m).all() and np.greater_equal(tile.upper_m, lower_m).all():
                octree.add(read_octree(self.tile_path(tile)))
        return octree


def open_map(folder: Path) -> MergedMap:
    """Return a finished merged map.

    Raises:
        RunError: The folder is missing, holds no merged map, or one that is not finished.
    """
    if not is_merged_map(folder):
        if is_merged_map(partial_of(folder)):
            raise RunError(f"{folder}: not finished; the command that began it resumes it")
        raise RunError(f"{folder}: no merged map; make one with mapper merge RUN… --out {folder}")
    try:
        tree = json.loads((folder / MANIFEST_NAME).read_bytes())
        drop_unknown(MapManifest, tree)
        manifest = MapManifest.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        raise RunError(
            f"{folder / MANIFEST_NAME}: {first['loc']}: {first['msg']}; by another version?"
        ) from None
    except (ValueError, RecursionError) as error:
        raise RunError(f"{folder / MANIFEST_NAME}: not valid JSON: {error}; it is damaged") from None
    config = BuildConfig(
        octree=manifest.octree,
        slice=manifest.slice,
        traversable=manifest.traversable,
        costmap=manifest.costmap,
    )
    return MergedMap(folder, config, manifest)
