"""Merging: the maps of many runs added up, tile by tile, to one map on disk."""

import shutil
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from mapper.core.errors import ConfigError, MapperError, RunError
from mapper.core.geometry import apply
from mapper.export.grid import write_grid
from mapper.graph.g2o import write_g2o
from mapper.loops.closure import write_closures
from mapper.merging.jobs import (
    FusedRun,
    JoinedTile,
    SlicedColumn,
    SplitRun,
    Workspace,
    fuse_run,
    join_tile,
    split_run,
    stays_within_m,
)
from mapper.merging.merged_map import (
    MERGED_MAP,
    RUNS,
    SCRATCH,
    TILES,
    MapManifest,
    MergedMap,
    RunInMap,
    Tile,
    open_map,
)
from mapper.merging.octomap_files import write_whole_bt, write_whole_ot
from mapper.merging.placing import Placed, Placing, warnings_about
from mapper.merging.slicing import draw, slice_map
from mapper.merging.stages import Cost, Stages
from mapper.merging.tiling import tiling_for
from mapper.navigation.traversable import Storey
from mapper.octree.config import OctreeConfig
from mapper.run import files
from mapper.run.doubtful_frames import without_doubtful
from mapper.run.fingerprint import fingerprint
from mapper.run.manifest import RunWarning
from mapper.run.warnings import merge_warnings
from mapper.runtime.atomic import MANIFEST_NAME, atomic_folder
from mapper.runtime.executor import IN_PROCESS, Workers, make_executor
from mapper.runtime.progress import SILENT, Progress
from mapper.runtime.resumable_jobs import JobRunner
from mapper.sources.trajectory_files import write_tum

DEFAULT_TILE_M = 50.0

_MUST_AGREE = (
    "resolution_m",
    "hit_probability",
    "miss_probability",
    "clamp_min_probability",
    "clamp_max_probability",
    "occupied_probability",
)


@dataclass(frozen=True, slots=True)
class Merged:
    """A finished merge.

    Attributes:
        map: The merged map.
        costs: Of the jobs of its stages: "split", one for each run, "join", one for each tile, and "slice",
            one for each column of tiles; in no order.
        shuffle_bytes: Size of the files between the first two stages.
    """

    map: MergedMap
    costs: Mapping[str, Sequence[Cost]]
    shuffle_bytes: int


def merge(
    placing: Placing,
    out: Path,
    *,
    tile_m: float = DEFAULT_TILE_M,
    workers: Workers = IN_PROCESS,
    progress: Progress = SILENT,
    overwrite: bool = False,
) -> Merged:
    """Add up the maps of runs, tile by tile, as independent evidence (Bayes, prior 0.5).

    No process ever holds more than one run's map, or one tile and one run's part of it. The bytes do not
    depend on where or in which order the jobs ran; the order of the runs shows in the last bit of a log-odds.
    A merge that was stopped goes on where it was when it is started again with the same runs.

    A run that a joint graph has bent by more than half a voxel is fused again along its new poses first; the
    run itself stays as it is.

    Args:
        placing: The runs, and the poses of their worlds.
        out: Folder to create; until it is whole it is called ``OUT.partial``.
        tile_m: About how long the edge of a tile is.
        workers: Where the jobs run; those of a Dask cluster must see the same files.
        progress: Receives stages, counts and notes.
        overwrite: Replace a map that is there, once the new one is whole.

    Raises:
        ConfigError: The runs do not agree in resolution or sensor model, or the tiles' edge is impossible.
        RunError: OUT is there already, a run comes twice or lacks its map, or a job failed.
    """
    placed = placing.placed
    config = _common_config(placed)
    tiling = tiling_for(config.resolution_m, tile_m)
    bent, stiff = _bent(placed, within_m=stays_within_m(config))
    manifest = MapManifest(
        status="merging",
        octree=config,
        slice=placed[0].run.config.slice,
        traversable=placed[0].run.config.traversable,
        costmap=placed[0].run.config.costmap,
        tile_m=tiling.edge_m,
        floor_z_m=_floor_z_m(placed[0]),
        runs=_described(placing, fused_again=bent),
        ties=() if placing.joint is None else placing.joint.ties,
        left_out=dict(placing.left_out),
    )
    with (
        make_executor(workers) as executor,
        atomic_folder(
            out, MERGED_MAP, overwrite=overwrite, keeps=lambda partial: _kept_of(partial, manifest)
        ) as folder,
    ):
        manifest.save(folder)
        warnings = [*placing.notes, *stiff, *warnings_about(placed)]
        for note in warnings:
            progress.note(note)
        workspace = Workspace(folder, folder / SCRATCH, tiling, config)
        stages = Stages(JobRunner(workspace.scratch / "done", progress), executor, progress)
        _write_poses(folder, placing, manifest)
        octrees = _fuse(workspace, stages, placed, manifest)
        split = _split(workspace, stages, placed, octrees)
        joined = _join(workspace, stages, split, follows_ground=manifest.slice.above == "ground")
        has_colors = any(part.has_colors for part in split)
        write_whole_ot(folder / files.OCTREE_OT, workspace, joined, has_colors=has_colors)
        write_whole_bt(folder / files.OCTREE_BT, workspace, joined)
        sliced = slice_map(workspace, stages, joined, manifest, placed)
        for note in sliced.missing:
            progress.note(note)
        notes = [*warnings, *sliced.missing]
        manifest = _completed(manifest, workspace, split, joined, sliced.columns, notes)
        apart = [warning.text for run in manifest.runs for warning in _warnings_of(run)]
        for note in apart:
            progress.note(note)
        manifest = manifest.model_copy(update={"notes": (*manifest.notes, *apart)})
        _write_storeys(folder, sliced.storeys)
        if sliced.grid is not None:
            write_grid(folder, files.SLICE, sliced.grid)
            draw(folder / files.SUMMARY, sliced.grid, placed, manifest)
        _clean(workspace, joined)
        manifest.save(folder)
    return Merged(
        map=open_map(out),
        costs=stages.costs,
        shuffle_bytes=sum(sum(part.part_bytes.values()) for part in split),
    )


def _common_config(placed: Sequence[Placed]) -> OctreeConfig:
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


def _bent(placed: Sequence[Placed], *, within_m: float) -> tuple[set[int], list[str]]:
    """Return the numbers of the runs to fuse again, and a line for each that should be and cannot."""
    again, stiff = set[int](), list[str]()
    for number, item in enumerate(placed):
        if item.moved_m <= within_m:
            continue
        try:
            item.run.open_log()
        except MapperError as error:
            stiff.append(
                f"{error}; so {item.run.path} is placed as a rigid body, and bends of up to "
                f"{item.moved_m:.2g} m stay in its map"
            )
        else:
            again.add(number)
    return again, stiff


def _described(placing: Placing, *, fused_again: Set[int]) -> tuple[RunInMap, ...]:
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
        )
        for number, (item, first_node) in enumerate(zip(placing.placed, first_nodes, strict=True))
    )


def _write_poses(folder: Path, placing: Placing, manifest: MapManifest) -> None:
    """Write every run's trajectory in the map, and the joint graph with the loops between runs."""
    for item, run in zip(placing.placed, manifest.runs, strict=True):
        (folder / run.folder).mkdir(parents=True, exist_ok=True)
        write_tum(folder / run.folder / files.TRAJECTORY, item.trajectory_map)
    if placing.joint is not None:
        write_g2o(folder / files.GRAPH, placing.joint.graph)
        write_closures(folder / files.LOOPS, placing.joint.loops)


def _fuse(
    workspace: Workspace, stages: Stages, placed: Sequence[Placed], manifest: MapManifest
) -> list[Path]:
    """Fuse the runs that have moved again; return the file of every run's octree."""
    octrees = [item.run.path.resolve() / files.OCTREE_MAP for item in placed]
    jobs = {}
    for number, (item, run) in enumerate(zip(placed, manifest.runs, strict=True)):
        if run.fused_again and item.bent is not None:
            octrees[number] = workspace.folder / run.folder / files.OCTREE_MAP
            poses = without_doubtful(item.bent, item.run.records)
            jobs[f"{number:04d}"] = partial(
                fuse_run, workspace, number, item.run.path.resolve(), poses, octrees[number]
            )
    if jobs:
        list(stages.run("fuse", jobs, FusedRun))
    return octrees


def _floor_z_m(first: Placed) -> float:
    """Return the height in the map of the first run's floor, below the middle of its path."""
    if first.stays:
        return 0.0
    middle = first.run.trajectory.positions_world.mean(axis=0) * [1.0, 1.0, 0.0]
    return float(apply(first.T_map_world, middle[np.newaxis])[0, 2])


def _write_storeys(folder: Path, storeys: Sequence[Storey]) -> None:
    """Write the floor of the storey where the first run begins, and where there are several, that of each."""
    for storey in storeys:
        if storey.is_home:
            write_grid(folder, files.TRAVERSABLE, storey.grid)
    for number, storey in enumerate(storeys[: files.MOST_STOREYS] if len(storeys) > 1 else ()):
        write_grid(folder, files.storey(number), storey.grid)


def _kept_of(partial: Path, manifest: MapManifest) -> list[str]:
    """Return the files of a folder that was left behind, if it is the beginning of this very merge."""
    try:
        begun = MapManifest.model_validate_json((partial / MANIFEST_NAME).read_bytes())
    except (OSError, ValidationError):
        return []
    return [child.name for child in partial.iterdir()] if begun == manifest else []


def _split(
    workspace: Workspace, stages: Stages, placed: Sequence[Placed], octrees: Sequence[Path]
) -> list[SplitRun]:
    jobs = {
        f"{index:04d}": partial(split_run, workspace, index, octree, None if item.stays else item.T_map_world)
        for index, (item, octree) in enumerate(zip(placed, octrees, strict=True))
    }
    done = dict(stages.run("split", jobs, SplitRun))
    return [done[name] for name in jobs]


def _join(
    workspace: Workspace, stages: Stages, split: Sequence[SplitRun], *, follows_ground: bool
) -> dict[int, JoinedTile]:
    """Return the result of every tile, in Morton order."""
    tiles = sorted({tile for part in split for tile in part.part_bytes})
    if not tiles:
        raise RunError("nothing is known in any of the runs' maps; there is nothing to merge")
    jobs = {
        workspace.tiling.name_of(tile): partial(
            join_tile,
            workspace,
            tile,
            [run for run, part in enumerate(split) if tile in part.part_bytes],
            has_colors=any(part.has_colors for part in split),
            follows_ground=follows_ground,
        )
        for tile in tiles
    }
    tile_of = dict(zip(jobs, tiles, strict=True))
    done = {}
    for name, joined in stages.run("join", jobs, JoinedTile):
        done[tile_of[name]] = joined
        shutil.rmtree(workspace.parts(tile_of[name]), ignore_errors=True)
    return {tile: done[tile] for tile in tiles}


def _completed(
    manifest: MapManifest,
    workspace: Workspace,
    split: Sequence[SplitRun],
    joined: Mapping[int, JoinedTile],
    columns: Sequence[SlicedColumn],
    notes: Sequence[str],
) -> MapManifest:
    """Return the manifest of the map when it is whole."""
    runs_of = {tile: [run for run, part in enumerate(split) if tile in part.part_bytes] for tile in joined}
    counts = np.zeros((len(split), 3), np.int64)
    for tile, result in joined.items():
        counts[runs_of[tile]] += np.array(result.overlaps)
    runs = tuple(
        run.model_copy(
            update={
                "voxels": part.voxels,
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
            "notes": tuple(notes),
        }
    )


def _warnings_of(run: RunInMap) -> list[RunWarning]:
    return merge_warnings(Path(run.path).name, agreement=run.agreement, shared_voxels=run.shared_voxels)


def _clean(workspace: Workspace, joined: Mapping[int, JoinedTile]) -> None:
    """Remove the scratch folder, and files that a killed worker may have left among the tiles."""
    shutil.rmtree(workspace.scratch)
    wanted = {workspace.tile(tile) for tile in joined}
    for file in (workspace.folder / TILES).iterdir():
        if file not in wanted:
            file.unlink()
