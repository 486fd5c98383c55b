"""Fusing: a run's maps, pictures and MCAP log made from its solved poses, and made again after a change."""

import shutil
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from mapper.config.build import BuildConfig
from mapper.core.errors import ConfigError, RunError
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.export.cloud_picture import write_cloud_views
from mapper.export.grid import write_grid
from mapper.export.mcap_log import McapLog
from mapper.export.mesh_files import write_cloud
from mapper.export.picture import write_summary
from mapper.export.run_mcap import log_maps, log_results, log_snapshot
from mapper.export.transforms import transforms_of
from mapper.mapping.config import Edits
from mapper.mapping.depth_noise_estimation import measure_noise
from mapper.mapping.fusion import Maps, fuse_log
from mapper.octree.map_file import write_map
from mapper.octree.octomap_file import write_bt, write_ot
from mapper.octree.scan_updates import ScanUpdateWriter, open_scan_updates
from mapper.pipeline.checkpoints import Checkpoints
from mapper.pipeline.fuse_checkpoints import MarkedUpdates, known_updates
from mapper.run import files
from mapper.run.edits_file import edits_text, parse_edits, write_edits
from mapper.run.folder import Run, moved_log, open_run
from mapper.run.frame_outcomes import FrameRecord
from mapper.run.input_logs import paths_of, refuse_another_log
from mapper.run.manifest import DepthReach, RunWarning, Solve, Status, Timing
from mapper.run.observers import NULL_OBSERVER, Observer
from mapper.run.results import RunResults
from mapper.run.stored_tracking import StoredTracking, load_tracking, save_solved
from mapper.run.verdict import DEPTH_TIME, FLOOR, find_warnings, floor_warnings, verdict_of
from mapper.run.writer import RunWriter, write_run
from mapper.runtime.atomic import is_temporary
from mapper.runtime.progress import SILENT, Progress
from mapper.sensing.depth import DepthLimit
from mapper.sources.base import Log
from mapper.sources.depth_time import with_depth_on_time

_FUSE_CONFIGS = frozenset(
    {"octree", "slice", "traversable", "cloud", "mcap", "mesh", "costmap", "octomap", "rerun", "workers"}
)
_TRACKING_STAGES = ("track", "solve", "level")


def fuse(
    source: Log,
    run: Run,
    config: BuildConfig,
    *,
    trajectory: Trajectory | None = None,
    progress: Progress = SILENT,
) -> Run:
    """Make a run's maps again, with another octree, slice, cloud or MCAP configuration or along other poses.

    A frame's update is taken from the old run where pose and rays are the same; the maps are those of fusing
    everything from scratch. The run stays as it is until the new maps are whole, and files that are not ours
    stay in it.

    Args:
        source: The log that the run was built from.
        run: A finished run.
        config: The run's own configuration with other map settings.
        trajectory: Body poses in the levelled world by which to replace the run's; None keeps those.
        progress: Receives stages, counts and notes.

    Raises:
        ConfigError: The configuration differs in a setting that tracking has used.
        RunError: The log is not the one that the run was built from, or the trajectory has no frame of it.
    """
    for name in sorted(set(BuildConfig.model_fields) - _FUSE_CONFIGS):
        if getattr(config, name) != getattr(run.config, name):
            raise ConfigError(f"{name}: fuse keeps what was tracked and cannot change it; run mapper build")
    changed = None if trajectory is None else _with_trajectory(run, trajectory)
    return fuse_changed(source, replace(run, config=config), changed, progress=progress)


def fuse_changed(
    source: Log,
    run: Run,
    changed: StoredTracking | None = None,
    *,
    solve: Solve | None = None,
    edits: str | None = None,
    progress: Progress = SILENT,
) -> Run:
    """Make a run's maps again after its graph, its poses or its edits have changed; see ``fuse``.

    Args:
        source: The log that the run was built from.
        run: A finished run, with the configuration to fuse by.
        changed: Tracking that replaces the run's own; None keeps that.
        solve: Record of the solve that changed it, for the manifest; None keeps the old one.
        edits: Text to replace the run's ``edits.toml``; None keeps that.
        progress: Receives stages, counts and notes.

    Raises:
        RunError: The log is not the one that the run was built from.
        ConfigError: The edits are not valid.
        DataError: They leave nothing of the map.
    """
    refuse_another_log(run.manifest.input, source, run=run.path)
    text = edits_text(run.path) if edits is None else edits
    wanted = parse_edits(text, run.path)
    status: Status = "building"
    manifest = moved_log(run, *paths_of(source)).manifest.model_copy(update={"status": status})
    with write_run(run.path, manifest, run.config, overwrite=True, takes_over=True) as writer:
        carry_times(writer, manifest.timing)
        _copy_kept_files(run, writer.folder)
        if edits is not None:
            write_edits(writer.folder, text)
        if changed is not None:
            save_solved(writer, changed)
            for name in files.names_of("poses"):
                (writer.folder / name).unlink(missing_ok=True)
        if solve is not None:
            writer.update(solve=solve)
        fuse_into(writer, source, run.config, progress, cached=run.scan_updates(), edits=wanted)
    return open_run(run.path)


def carry_times(writer: RunWriter, timing: Timing) -> None:
    """Count the time that tracking took in an earlier run as this one's."""
    for stage in _TRACKING_STAGES:
        writer.clock.seconds[stage] = timing.stage_s[stage]


def _with_trajectory(run: Run, trajectory: Trajectory) -> StoredTracking:
    tracked = load_tracking(run)
    T_world_body = dict(trajectory.items())
    if T_world_body.keys().isdisjoint(tracked.trajectory.stamps_ns.tolist()):
        raise RunError(f"{run.path}: none of the trajectory's {len(trajectory)} stamps is one of the run's")
    graph = tracked.graph
    moved = {node: T_world_body.get(graph.stamps_ns[node], T) for node, T in graph.T_world_node.items()}
    records = [_given(record) if record.stamp_ns in T_world_body else record for record in tracked.records]
    return replace(tracked, records=records, trajectory=trajectory, graph=graph.with_poses(moved))


def _given(record: FrameRecord) -> FrameRecord:
    """Return the record of a frame whose pose a user gave: no doubt of the tracking concerns that pose."""
    if record.outcome != "doubtful":
        return record
    return replace(record, outcome="tracked", doubts=(), sigmas=None, pose_in_node=None)


def _copy_kept_files(run: Run, new: Path) -> None:
    """Copy the results of tracking and a user's own files; what was made from the old maps is left out."""
    needed = files.names_of("tracking") - files.DISPENSABLE
    for name in needed:
        run.file(name)
    made_again = files.names_of("maps", "exported maps")
    for child in run.path.iterdir():
        if child.name in made_again or is_temporary(child.name):
            continue
        if child.name not in needed:
            run.file(child.name)
        if child.is_dir() and not child.is_symlink():
            shutil.copytree(child, new / child.name, symlinks=True)
        else:
            shutil.copy2(child, new / child.name, follow_symlinks=False)


def fuse_into(
    writer: RunWriter,
    source: Log,
    config: BuildConfig,
    progress: Progress,
    *,
    cached: Path | None = None,
    edits: Edits | None = None,
    observer: Observer = NULL_OBSERVER,
    checkpoints: Checkpoints | None = None,
) -> None:
    """Fuse the trajectory of an unfinished run and write everything that is made from the maps.

    Args:
        writer: Writer of the run, which has its trajectory, graph and frame records.
        source: The log that was tracked.
        config: All settings.
        progress: Receives stages, counts and notes.
        cached: File of the frames' updates from the last time; None casts every frame.
        edits: Edits by hand.
        observer: Receives the results.
        checkpoints: Keep the updates that are cast; ``cached`` is then theirs.

    Raises:
        DataError: The edits leave nothing of the map, or nothing in the height of the slice.
    """
    run = Run(writer.folder, config, writer.manifest)
    results, transforms = run.results, transforms_of(run)
    if not config.mcap.frame_times:
        results = replace(results, frame_ms={})
    make_writer = ScanUpdateWriter if checkpoints is None else partial(MarkedUpdates, checkpoints=checkpoints)
    with writer.clock.stage("fuse"):
        source, late_depth = with_depth_on_time(source, config.source)
        if late_depth:
            progress.note(late_depth)
        settings = _with_depth_noise(writer, source, config, progress)
        if checkpoints is not None:
            cached = known_updates(checkpoints, settings.octree)
    with McapLog(writer.folder / files.MCAP) as log:
        with (
            writer.clock.stage("fuse"),
            open_scan_updates(cached) if cached is not None else nullcontext() as known,
            make_writer(writer.folder / files.SCAN_UPDATES, settings.octree) as updates,
        ):
            maps = fuse_log(
                writer.manifest.with_body_rates(source),
                results.tracked,
                settings,
                progress=progress,
                on_snapshot=partial(log_snapshot, log, transforms),
                cached=known,
                updates=updates,
                edits=edits or Edits(),
            )
        with writer.clock.stage("write"):
            log_results(log, results, transforms)
            log_maps(log, maps, stamp_ns=int(results.trajectory.stamps_ns[0]))
            _write_maps(writer.folder, maps)
            _write_pictures(writer, maps, results, has_colors=source.has_colours)
    found_anew = {FLOOR, DEPTH_TIME} if late_depth else {FLOOR}
    others = [warning for warning in writer.manifest.warnings if warning.kind not in found_anew]
    if late_depth:
        others.append(RunWarning(kind=DEPTH_TIME, sentence=late_depth))
    found = floor_warnings(config.traversable, config.octree.resolution_m, has_path=maps.has_path)
    writer.update(warnings=(*others, *found), edits=maps.edits)
    warnings = find_warnings(results, writer.manifest)
    writer.update(warnings=tuple(warnings), verdict=verdict_of(warnings))
    _write_counts(writer, maps, results.trajectory)
    observer.on_mapped(Run(writer.folder, config, writer.manifest), results, maps)


def _write_counts(writer: RunWriter, maps: Maps, trajectory: Trajectory) -> None:
    counts = writer.manifest.counts.model_copy(
        update={
            "leaves": len(maps.octree),
            "occupied": maps.octree.count_occupied(),
            "cloud_points": len(maps.cloud),
            "dynamic_points": len(maps.dynamic),
        }
    )
    writer.update(counts=counts)
    log_s = _duration_s(trajectory, [log.begins_ns for log in writer.manifest.input.appended])
    writer.record_timing(log_s=log_s, frames=counts.read)


def _with_depth_noise(writer: RunWriter, source: Log, config: BuildConfig, progress: Progress) -> BuildConfig:
    """Return the settings with the noise of the log's camera, which limits the depth that counts."""
    octree = config.octree
    logs = (source, *(sensor.log for sensor in source.beside))
    camera = next((log for log in logs if log.sensor == "rgbd"), None)
    if camera is None or octree.max_range_m is not None:
        writer.update(depth=None)
        return config
    given = octree.depth_noise or getattr(config.odometry, "depth_noise", None)
    measured = measure_noise(camera, given=given, workers=config.workers)
    settings = octree.model_copy(update={"depth_noise": measured.noise})
    limit_m = DepthLimit(measured.noise, max_sigma_m=octree.resolution_m).depth_m
    reach = DepthReach(
        noise=measured.noise,
        detail=measured.detail,
        limit_m=limit_m,
        counted_ratio=measured.share_within(limit_m),
    )
    progress.note(reach.sentence)
    writer.update(depth=reach)
    return config.model_copy(update={"octree": settings})


def _write_maps(folder: Path, maps: Maps) -> None:
    write_bt(folder / files.OCTREE_BT, maps.octree)
    write_ot(folder / files.OCTREE_OT, maps.octree)
    write_map(folder / files.OCTREE_MAP, maps.octree)
    for name, cloud in ((files.CLOUD, maps.cloud), (files.DYNAMIC, maps.dynamic)):
        write_cloud(folder / name, cloud)
    write_grid(folder, files.SLICE, maps.grid)
    write_grid(folder, files.TRAVERSABLE, maps.traversable)
    if maps.keepout is not None:
        write_grid(folder, files.KEEPOUT, maps.keepout)
    for number, storey in enumerate(maps.storeys[: files.MOST_STOREYS]):
        write_grid(folder, files.storey(number), storey)


def _write_pictures(writer: RunWriter, maps: Maps, results: RunResults, *, has_colors: bool) -> None:
    counts, levelling = writer.manifest.counts, writer.manifest.levelling
    trajectory, graph = results.trajectory, results.graph
    lines = [f"{len(trajectory)} frames, {counts.nodes} keyframes, {trajectory.path_length_m:.2f} m of path"]
    if levelling is not None:
        lines.append(f"levelled by {levelling.method}")
    write_summary(
        writer.folder / files.SUMMARY,
        grid=maps.grid,
        trajectory=trajectory,
        truth=results.truth,
        loops_world=graph.loops_world,
        title=writer.manifest.input.title,
        lines=lines,
        poses=results.poses,
    )
    if len(maps.cloud):
        write_cloud_views(
            writer.folder / files.CLOUD_VIEWS,
            maps.cloud.points,
            maps.cloud.colors,
            trajectory,
            has_colors=has_colors,
        )


def _duration_s(trajectory: Trajectory, begins_ns: Sequence[int]) -> float:
    """Return the seconds from first to last frame, without the pauses before logs that begin later."""
    sessions = np.split(trajectory.stamps_ns, np.searchsorted(trajectory.stamps_ns, begins_ns))
    return float(sum(stamps[-1] - stamps[0] for stamps in sessions if len(stamps))) / NS_PER_S
