"""Merging: the maps of many runs added up, tile by tile, to one map on disk."""

import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from mapper.core.errors import RunError
from mapper.export.grid import write_grid
from mapper.export.picture import write_merged
from mapper.merging.jobs import (
    JoinedTile,
    SlicedColumn,
    SplitRun,
    Workspace,
    join_tile,
    keep_tile,
    split_run,
    stays_within_m,
    write_whole_bt,
    write_whole_ot,
)
from mapper.merging.merged_map import (
    MERGED_MAP,
    SCRATCH,
    TILES,
    MapManifest,
    MergedMap,
    RunInMap,
    Tile,
    open_map,
    tiling_for,
)
from mapper.merging.runs_in_map import (
    KnownTile,
    KnownTiles,
    common_config,
    describe_runs,
    floor_z_m,
    fuse_runs,
    keep_runs,
    known_tiles,
    runs_to_fuse,
    write_poses,
)
from mapper.merging.slicing import Sliced, slice_map
from mapper.merging.world_poses import Placed, Placing, warnings_about
from mapper.octree.config import OctreeConfig
from mapper.octree.grid import OccupancyGrid
from mapper.run import files
from mapper.run.verdict import merge_warnings
from mapper.runtime.atomic import MANIFEST_NAME, atomic_folder
from mapper.runtime.executor import IN_PROCESS, Workers, make_executor
from mapper.runtime.progress import SILENT, Progress
from mapper.runtime.resumable_jobs import Cost, JobRunner, Stages

DEFAULT_TILE_M = 50.0


@dataclass(frozen=True, slots=True, repr=False)
class Merged:
    """A finished merge.

    Attributes:
        map: The merged map.
        costs: Costs of the jobs of each stage, in no order: "split" has a job for each run, "join" one for
            each tile, "slice" one for each column of tiles.
        shuffle_bytes: Size of the files between the first two stages.
    """

    map: MergedMap
    costs: Mapping[str, Sequence[Cost]]
    shuffle_bytes: int

    def __repr__(self) -> str:
        return f"Merged({self.map}, {self.map.manifest.summary})"


def merge(
    placing: Placing,
    out: Path,
    *,
    tile_m: float = DEFAULT_TILE_M,
    workers: Workers = IN_PROCESS,
    progress: Progress = SILENT,
    overwrite: bool = False,
    known: MergedMap | None = None,
) -> Merged:
    """Add up the maps of runs, tile by tile, as independent evidence (Bayes, prior 0.5).

    No process ever holds more than one run's map, or one tile and one run's part of it. The bytes do not
    depend on where or in which order the jobs ran; the order of the runs shows in the last bit of a log-odds.
    A merge that was stopped is resumed when it is started again with the same runs.

    A run that a joint graph has bent by more than half a voxel is fused again along its new poses first; the
    run itself stays as it is.

    Args:
        placing: The runs, and the poses of their worlds.
        out: Folder to create; until it is whole it is called ``OUT.partial``.
        tile_m: About how long the edge of a tile is.
        workers: Workers that run the jobs; those of a Dask cluster must see the same files.
        progress: Receives stages, counts and notes.
        overwrite: Replace a map that is there, once the new one is whole.
        known: A map of the first of these runs, to which the others are added. What has not moved in it by
            more than half a voxel stays, and so do tiles that no other run reaches.

    Raises:
        ConfigError: The runs do not agree in resolution or sensor model, or the tiles' edge is impossible.
        RunError: OUT is there already, a run comes twice or lacks its map, or a job failed.
    """
    config = common_config(placing.placed)
    if known is not None:
        placing = replace(placing, placed=keep_runs(known, placing.placed, config))
    placed = placing.placed
    tiling = tiling_for(config.resolution_m, tile_m)
    bent, rigid = runs_to_fuse(placed, within_m=stays_within_m(config))
    manifest = _first_manifest(placing, config, tile_m=tiling.edge_m, fused_again=bent)
    with (
        make_executor(workers) as executor,
        atomic_folder(
            out, MERGED_MAP, overwrite=overwrite, keeps=lambda partial: _kept_of(partial, manifest)
        ) as folder,
    ):
        manifest.save(folder)
        warnings = [*placing.notes, *rigid, *warnings_about(placed)]
        for note in warnings:
            progress.note(note)
        follows_ground = manifest.slice.above == "ground"
        workspace = Workspace(folder, folder / SCRATCH, tiling, config, follows_ground)
        stages = Stages(JobRunner(workspace.scratch / "done", progress), executor, progress)
        write_poses(folder, placing, manifest)
        octrees = fuse_runs(workspace, stages, placed, manifest)
        tiles = None if known is None else known_tiles(known, placed, manifest, tiling)
        split, untouched = _split(workspace, stages, placed, octrees, tiles)
        workspace = replace(workspace, has_colors=any(part.has_colors for part in split))
        joined = _join(workspace, stages, split, untouched)
        write_whole_ot(folder / files.OCTREE_OT, workspace, joined)
        write_whole_bt(folder / files.OCTREE_BT, workspace, joined)
        sliced = slice_map(workspace, stages, joined, manifest, placed)
        manifest = _complete(manifest, workspace, split, joined, sliced.columns)
        missing = [reason for reason in (sliced.no_floor, sliced.no_slice) if reason]
        notes = [*missing, *_disagreements(manifest.runs)]
        for note in notes:
            progress.note(note)
        manifest = manifest.model_copy(update={"notes": (*warnings, *notes), "no_floor": sliced.no_floor})
        _write_grids(folder, sliced, placed, manifest)
        _clean(workspace, joined)
        manifest.save(folder)
    return Merged(
        map=open_map(out),
        costs=stages.costs,
        shuffle_bytes=sum(sum(part.part_bytes.values()) for part in split),
    )


def _first_manifest(
    placing: Placing, config: OctreeConfig, *, tile_m: float, fused_again: set[int]
) -> MapManifest:
    """Return the manifest of a map that is being merged; the first run's settings apply to all of it."""
    first = placing.placed[0]
    return MapManifest(
        status="merging",
        octree=config,
        slice=first.run.config.slice,
        traversable=first.run.config.traversable,
        costmap=first.run.config.costmap,
        tile_m=tile_m,
        floor_z_m=floor_z_m(first),
        runs=describe_runs(placing, fused_again=fused_again),
        ties=() if placing.joint is None else placing.joint.ties,
        left_out=dict(placing.left_out),
    )


def draw(path: Path, grid: OccupancyGrid, placed: Sequence[Placed], manifest: MapManifest) -> None:
    """Draw the runs' paths over the slice."""
    write_merged(
        path,
        grid=grid,
        paths_world={item.run.path.name: item.trajectory_map.positions_world for item in placed},
        tile_m=manifest.tile_m,
        title=f"{len(placed)} runs merged",
        lines=[manifest.summary],
    )


def _write_grids(folder: Path, sliced: Sliced, placed: Sequence[Placed], manifest: MapManifest) -> None:
    """Write the slice with its picture, and the floor of the storey where the first run begins.

    Where there are several storeys, the floor of each is written, too.
    """
    if sliced.grid is not None:
        write_grid(folder, files.SLICE, sliced.grid)
        if sliced.keepout is not None:
            write_grid(folder, files.KEEPOUT, sliced.keepout)
        draw(folder / files.SUMMARY, sliced.grid, placed, manifest)
    if sliced.floor is not None:
        write_grid(folder, files.TRAVERSABLE, sliced.floor.home.grid)
        for number, storey in enumerate(sliced.floor.over_each_other[: files.MOST_STOREYS]):
            write_grid(folder, files.storey(number), storey)


def _kept_of(partial: Path, manifest: MapManifest) -> list[str]:
    """Return the files of a folder that was left behind, if it is the beginning of this very merge."""
    try:
        begun = MapManifest.model_validate_json((partial / MANIFEST_NAME).read_bytes())
    except (OSError, ValidationError):
        return []
    return [child.name for child in partial.iterdir()] if begun == manifest else []


def _split(
    workspace: Workspace,
    stages: Stages,
    placed: Sequence[Placed],
    octrees: Sequence[Path],
    known: KnownTiles | None,
) -> tuple[list[SplitRun], Mapping[int, KnownTile]]:
    """Cut runs into tiles; return what each has in every tile, and the known tiles that nothing new reaches.

    Runs that are kept are cut only where tiles have to be summed again.
    """

    def jobs(numbers: Iterable[int], only: frozenset[int] | None) -> dict[str, Callable[[], SplitRun]]:
        return {
            f"{number:04d}": partial(
                split_run,
                workspace,
                number,
                octrees[number],
                None if placed[number].stays else placed[number].T_map_world,
                only,
            )
            for number in numbers
        }

    kept = set[int]() if known is None else known.kept
    fresh = [number for number in range(len(placed)) if number not in kept]
    done = dict(stages.run("split", jobs(fresh, None), SplitRun))
    if known is None:
        return [done[f"{number:04d}"] for number in fresh], {}
    changed = known.changed_by({tile for part in done.values() for tile in part.part_bytes})
    again = [number for number in sorted(kept) if changed & known.tiles_of(number)]
    done |= dict(stages.run("split", jobs(again, changed), SplitRun))
    split = [
        known.complete(number, done.get(f"{number:04d}"), changed)
        if number in kept
        else done[f"{number:04d}"]
        for number in range(len(placed))
    ]
    return split, known.untouched(changed)


def _join(
    workspace: Workspace,
    stages: Stages,
    split: Sequence[SplitRun],
    untouched: Mapping[int, KnownTile],
) -> dict[int, JoinedTile]:
    tiles = sorted({tile for part in split for tile in part.part_bytes})
    if not tiles:
        raise RunError("nothing is known in any of the runs' maps; there is nothing to merge")
    jobs: dict[str, Callable[[], JoinedTile]] = {}
    for tile in tiles:
        if tile in untouched:
            job = partial(keep_tile, workspace, tile, *untouched[tile])
        else:
            runs = [run for run, part in enumerate(split) if tile in part.part_bytes]
            job = partial(join_tile, workspace, tile, runs)
        jobs[workspace.tiling.name_of(tile)] = job
    tile_of = dict(zip(jobs, tiles, strict=True))
    done = {}
    for name, joined in stages.run("join", jobs, JoinedTile):
        done[tile_of[name]] = joined
        shutil.rmtree(workspace.parts(tile_of[name]), ignore_errors=True)
    return {tile: done[tile] for tile in tiles}


def _complete(
    manifest: MapManifest,
    workspace: Workspace,
    split: Sequence[SplitRun],
    joined: Mapping[int, JoinedTile],
    columns: Sequence[SlicedColumn],
) -> MapManifest:
    runs_of = {tile: [run for run, part in enumerate(split) if tile in part.part_bytes] for tile in joined}
    counts = np.zeros((len(split), 3), np.int64)
    for tile, result in joined.items():
        counts[runs_of[tile]] += np.array(result.overlaps)
    runs = tuple(
        run.model_copy(
            update={
                "voxels": part.voxels,
                "has_colors": part.has_colors,
                "shared_voxels": int(shared),
                "agreement": round(float(both / either), 4) if either else None,
            }
        )
        for run, part, (shared, both, either) in zip(manifest.runs, split, counts, strict=True)
    )
    lower_m = {tile: workspace.tiling.lower_m(tile) for tile in joined}
    tiles = tuple(
        Tile(
            name=workspace.tiling.name_of(tile),
            lower_m=tuple(lower_m[tile].tolist()),
            upper_m=tuple((lower_m[tile] + workspace.tiling.edge_m).tolist()),
            voxels=result.voxels,
            runs=tuple(runs_of[tile]),
            overlaps=tuple(tuple(overlap) for overlap in result.overlaps),
        )
        for tile, result in joined.items()
    )
    area_m2 = sum(column.known_columns for column in columns) * workspace.tiling.resolution_m**2
    return manifest.model_copy(
        update={
            "status": "complete",
            "runs": runs,
            "tiles": tiles,
            "voxels": sum(result.voxels for result in joined.values()),
            "area_km2": round(area_m2 / 1e6, 9),
        }
    )


def _disagreements(runs: Sequence[RunInMap]) -> list[str]:
    """Return a line for each run whose walls are not where those of the runs before it are."""
    return [
        warning.text
        for run in runs
        for warning in merge_warnings(
            Path(run.path).name, agreement=run.agreement, shared_voxels=run.shared_voxels
        )
    ]


def _clean(workspace: Workspace, joined: Mapping[int, JoinedTile]) -> None:
    """Remove the scratch folder, and files that a killed worker may have left among the tiles."""
    shutil.rmtree(workspace.scratch)
    wanted = {workspace.tile(tile) for tile in joined}
    for file in (workspace.folder / TILES).iterdir():
        if file not in wanted:
            file.unlink()
