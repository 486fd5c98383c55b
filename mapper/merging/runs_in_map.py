"""Runs of a merged map: the settings that they share, their poses, and what is kept of an earlier map."""

import shutil
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mapper.core.errors import ConfigError, MapperError, RunError
from mapper.core.geometry import apply
from mapper.graph.g2o import write_g2o
from mapper.loops.closure import write_closures
from mapper.mapping.config import edits_of
from mapper.merging.jobs import FusedRun, SplitRun, Workspace, fuse_run, stays_within_m
from mapper.merging.merged_map import FUSED, RUNS, MapManifest, MergedMap, RunInMap, Tile, Tiling
from mapper.merging.world_poses import InMap, Placed, Placing, farthest_m
from mapper.octree.config import OctreeConfig
from mapper.octree.sparse_grid import Overlap
from mapper.run import files
from mapper.run.doubtful_frames import without_doubtful
from mapper.run.folder import Run, open_run
from mapper.run.input_logs import fingerprint
from mapper.runtime.atomic import atomic_file
from mapper.runtime.resumable_jobs import Stages
from mapper.sources.trajectory_files import read_tum, write_tum

_MUST_AGREE = (
    "resolution_m",
    "hit_probability",
    "miss_probability",
    "clamp_min_probability",
    "clamp_max_probability",
    "occupied_probability",
)


def common_config(placed: Sequence[Placed]) -> OctreeConfig:
    """Return the configuration of the map, after checking that the runs can be merged."""
    if not placed:
        raise ConfigError("nothing to merge; name the run folders")
    first = placed[0].run
    seen: set[Path] = set()
    for run in (item.run for item in placed):
        if not (run.path / files.OCTREE_MAP).is_file():
            raise RunError(f"{run.path}: has no {files.OCTREE_MAP}; make it with mapper fuse {run.path}")
        if run.path.resolve() in seen:
            raise RunError(f"{run.path}: given twice, and its evidence would count twice; name it once")
        seen.add(run.path.resolve())
        for name in _MUST_AGREE:
            value, wanted = getattr(run.config.octree, name), getattr(first.config.octree, name)
            if value != wanted:
                raise ConfigError(
                    f"{run.path}: octree.{name} is {value:g}, but {wanted:g} in {first.path}; make its maps "
                    f"again with mapper fuse {run.path} --set octree.{name}={wanted:g}"
                )
    attributes = all(item.run.config.octree.attributes for item in placed)
    return first.config.octree.model_copy(update={"attributes": attributes})


def floor_z_m(first: Placed) -> float:
    """Return the height in the map of the first run's floor, below the middle of its path."""
    if first.stays:
        return 0.0
    middle = first.run.trajectory.positions_world.mean(axis=0) * [1.0, 1.0, 0.0]
    return float(apply(first.T_map_world, middle[np.newaxis])[0, 2])


def runs_to_fuse(placed: Sequence[Placed], *, within_m: float) -> tuple[set[int], list[str]]:
    """Return the numbers of the runs to fuse again, and a line for each that should be and cannot."""
    again, rigid = set[int](), list[str]()
    for number, item in enumerate(placed):
        if item.kept is not None:
            again |= {number} if item.kept.fused_again else set()
            continue
        if item.moved_m <= within_m:
            continue
        try:
            item.run.open_log()
        except MapperError as error:
            rigid.append(
                f"{error}; so {item.run.path} is placed as a rigid body, and bends of up to "
                f"{item.moved_m:.2g} m stay in its map"
            )
        else:
            again.add(number)
    return again, rigid


def describe_runs(placing: Placing, *, fused_again: Set[int]) -> tuple[RunInMap, ...]:
    """Return the manifest's entries of the runs before they are merged."""
    first_nodes = (
        [None] * len(placing.placed) if placing.joint is None else placing.joint.first_nodes.values()
    )
    return tuple(
        RunInMap(
            path=str(item.run.path.resolve()),
            fingerprint=fingerprint(item.run.file(files.OCTREE_MAP)),
            T_map_world=tuple(tuple(row) for row in item.T_map_world.tolist()),
            placed=item.how,
            folder=f"{RUNS}/{number:04d}_{item.run.path.resolve().name}",
            first_node=first_node,
            moved_m=round(item.moved_m, 6),
            fused_again=number in fused_again,
            keepout=edits_of(item.run.manifest.edits).keepout,
        )
        for number, (item, first_node) in enumerate(zip(placing.placed, first_nodes, strict=True))
    )


def write_poses(folder: Path, placing: Placing, manifest: MapManifest) -> None:
    """Write every run's trajectory in the map, and the joint graph with the loops between runs."""
    for item, run in zip(placing.placed, manifest.runs, strict=True):
        (folder / run.folder).mkdir(parents=True, exist_ok=True)
        write_tum(folder / run.folder / files.TRAJECTORY, item.trajectory_map)
        if item.kept is not None and run.fused_again:
            for name in (files.OCTREE_MAP, FUSED):
                with atomic_file(folder / run.folder / name) as part:
                    shutil.copyfile(item.kept.folder / name, part)
    if placing.joint is not None:
        write_g2o(folder / files.GRAPH, placing.joint.graph)
        write_closures(folder / files.LOOPS, placing.joint.loops)


def fuse_runs(
    workspace: Workspace, stages: Stages, placed: Sequence[Placed], manifest: MapManifest
) -> list[Path]:
    """Fuse the runs that have moved again; return the file of every run's octree."""
    octrees = [item.run.path.resolve() / files.OCTREE_MAP for item in placed]
    jobs = {}
    for number, (item, run) in enumerate(zip(placed, manifest.runs, strict=True)):
        if run.fused_again:
            octrees[number] = workspace.folder / run.folder / files.OCTREE_MAP
        if run.fused_again and item.bent is not None:
            poses = without_doubtful(item.bent, item.run.records)
            write_tum(workspace.folder / run.folder / FUSED, poses)
            jobs[f"{number:04d}"] = partial(
                fuse_run, workspace, number, item.run.path.resolve(), poses, octrees[number]
            )
    if jobs:
        list(stages.run("fuse", jobs, FusedRun))
    return octrees


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

    def complete(self, number: int, again: SplitRun | None, changed: Set[int]) -> SplitRun:
        """Return what a kept run has in all tiles: those that it was cut into again, and the others."""
        member = self.map.manifest.runs[number]
        parts = {} if again is None else again.part_bytes
        parts = parts | dict.fromkeys(sorted(self.tiles_of(number) - changed), 0)
        has_colors = member.has_colors or (again is not None and again.has_colors)
        return SplitRun(part_bytes=parts, voxels=member.voxels, has_colors=has_colors)


def keep_runs(known: MergedMap, placed: Sequence[Placed], config: OctreeConfig) -> list[Placed]:
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
    return [_keep(known, member, item, config) for member, item in zip(members, placed, strict=False)] + list(
        placed[len(members) :]
    )


def _keep(known: MergedMap, member: RunInMap, item: Placed, config: OctreeConfig) -> Placed:
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
        placed: The runs of the map that is to be made, those of the earlier one first, from ``keep_runs``.
        manifest: Manifest of the new map.
        tiling: Tiling of the new map.
    """
    before = known.manifest
    kept = {number for number, item in enumerate(placed) if item.kept is not None}
    if before.tile_m != manifest.tile_m or not all(tile.overlaps for tile in before.tiles):
        return None
    return KnownTiles(known, kept, {tiling.tile_named(tile.name): tile for tile in before.tiles})
