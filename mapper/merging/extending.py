"""Adding runs to a merged map: what of it still holds, and what has to be merged again."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mapper.core.errors import RunError
from mapper.merging.jobs import SplitRun, stays_within_m
from mapper.merging.merged_map import FUSED, MapManifest, MergedMap, RunInMap, Tile
from mapper.merging.placing import InMap, Placed, farthest_m
from mapper.merging.tiling import Tiling
from mapper.octree.blocks import Overlap
from mapper.octree.config import OctreeConfig
from mapper.run import files
from mapper.run.fingerprint import fingerprint
from mapper.run.folder import Run, open_run
from mapper.sources.trajectory_files import read_tum


def runs_of(known: MergedMap) -> list[Run]:
    """Return the runs of a merged map, after comparing their maps with those that were merged.

    Raises:
        RunError: A run is gone, or has changed since.
    """
    runs = []
    for member in known.manifest.runs:
        run = open_run(Path(member.path))
        if fingerprint(run.file(files.OCTREE_MAP)) != member.fingerprint:
            raise RunError(f"{run.path}: changed since it was merged into {known.path}; merge again")
        runs.append(run)
    return runs


class KnownTile(NamedTuple):
    """A tile of an earlier map that holds.

    Attributes:
        path: Its file.
        overlaps: Overlap of each of its runs with the sum of those before.
    """

    path: Path
    overlaps: tuple[Overlap, ...]


@dataclass(frozen=True, slots=True, eq=False)
class KnownTiles:
    """Tiles of a merged map, which hold unless a run that is new or has moved reaches them.

    Attributes:
        map: The merged map.
        kept: Numbers of the runs that lie as they did in it.
        tiles: Its tiles, by their Morton codes.
    """

    map: MergedMap
    kept: Set[int]
    tiles: Mapping[int, Tile]

    def tiles_of(self, number: int) -> frozenset[int]:
        """Return the tiles in which a run has a known voxel."""
        return frozenset(code for code, tile in self.tiles.items() if number in tile.runs)

    def changed_by(self, reached: Set[int]) -> frozenset[int]:
        """Return the tiles to sum again: those that other runs reach now, or reached in that map."""
        crossed = {code for code, tile in self.tiles.items() if not set(tile.runs) <= self.kept}
        return frozenset(reached | crossed)

    def untouched(self, changed: Set[int]) -> dict[int, KnownTile]:
        """Return the tiles that are not among the changed ones."""
        return {
            code: KnownTile(
                self.map.tile_path(tile).resolve(), tuple(Overlap(*overlap) for overlap in tile.overlaps)
            )
            for code, tile in self.tiles.items()
            if code not in changed
        }

    def completed(self, number: int, again: SplitRun | None, changed: Set[int]) -> SplitRun:
        """Return what a kept run has in all tiles: those that it was cut into again, and the others."""
        member = self.map.manifest.runs[number]
        parts = {} if again is None else again.part_bytes
        parts = parts | dict.fromkeys(sorted(self.tiles_of(number) - changed), 0)
        has_colors = member.has_colors or (again is not None and again.has_colors)
        return SplitRun(part_bytes=parts, voxels=member.voxels, has_colors=has_colors)


def kept_in(known: MergedMap, placed: Sequence[Placed], config: OctreeConfig) -> list[Placed]:
    """Return the runs with those as they lie in a map that have not moved by more than half a voxel.

    Args:
        known: The map.
        placed: Its runs in their order, and then others.
        config: Settings of the new map's octree.
    """
    members = known.manifest.runs
    is_same = config == known.manifest.octree
    if not is_same or [item.run.path.resolve() for item in placed[: len(members)]] != [
        Path(member.path) for member in members
    ]:
        return list(placed)
    return [_kept(known, member, item, config) for member, item in zip(members, placed, strict=False)] + list(
        placed[len(members) :]
    )


def _kept(known: MergedMap, member: RunInMap, item: Placed, config: OctreeConfig) -> Placed:
    T_map_world, run, folder = np.array(member.T_map_world), item.run, known.path / member.folder
    fused = read_tum(folder / FUSED) if member.fused_again else run.tracked_trajectory
    moved_m = farthest_m(fused.moved(T_map_world), item.trajectory_map, run.fused_config.octree)
    if moved_m > stays_within_m(config):
        return item
    kept = InMap(folder, item.trajectory_map, member.moved_m, member.fused_again)
    return replace(item, T_map_world=T_map_world, bent=None, kept=kept)


def known_tiles(
    known: MergedMap, placed: Sequence[Placed], manifest: MapManifest, tiling: Tiling
) -> KnownTiles | None:
    """Return the tiles of a map that may hold in the one that is to be made; None if it is cut differently.

    Args:
        known: The earlier map.
        placed: The runs of the map that is to be made, those of the earlier one first, from ``kept_in``.
        manifest: Manifest of the new map.
        tiling: Tiling of the new map.
    """
    before = known.manifest
    kept = {number for number, item in enumerate(placed) if item.kept is not None}
    if before.tile_m != manifest.tile_m or not all(tile.overlaps for tile in before.tiles):
        return None
    return KnownTiles(known, kept, {tiling.tile_named(tile.name): tile for tile in before.tiles})
