"""The second pass of a build: maps, pictures and MCAP log of a run, made from its solved poses."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from mapper.config.build import BuildConfig
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
from mapper.mapping.map_building import Maps, ScanSnapshot, Snapshot, build_maps
from mapper.octree.map_file import write_map
from mapper.octree.octomap_file import write_bt, write_ot
from mapper.octree.scan_updates import ScanUpdateWriter, open_scan_updates
from mapper.pipeline.checkpoints import Checkpoints
from mapper.pipeline.fuse_checkpoints import MarkedUpdates, known_updates
from mapper.run import files
from mapper.run.folder import Run
from mapper.run.manifest import DepthReach, RunWarning
from mapper.run.observers import NULL_OBSERVER, Observer
from mapper.run.results import RunResults
from mapper.run.verdict import DEPTH_TIME, FLOOR, find_warnings, floor_warnings, verdict_of
from mapper.run.writer import RunWriter
from mapper.runtime.progress import Progress
from mapper.sensing.depth import DepthLimit
from mapper.sources.base import Log
from mapper.sources.depth_time import with_depth_on_time


def write_maps(
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
    """Build the maps along the trajectory of an unfinished run, and write everything that is made from them.

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
    with writer.clock.stage("fuse"):
        source, late_depth = with_depth_on_time(source, config.source)
        if late_depth:
            progress.note(late_depth)
        settings = _with_depth_noise(writer, source, config, progress)
    with McapLog(writer.folder / files.MCAP) as log:
        with writer.clock.stage("fuse"):
            maps = _built(
                writer,
                source,
                results.tracked,
                settings,
                progress,
                on_snapshot=partial(log_snapshot, log, transforms),
                cached=cached,
                edits=edits or Edits(),
                checkpoints=checkpoints,
            )
        with writer.clock.stage("write"):
            log_results(log, results, transforms)
            log_maps(log, maps, stamp_ns=int(results.trajectory.stamps_ns[0]))
            _write_files(writer.folder, maps)
            _write_pictures(writer, maps, results, has_colors=source.has_colours)
    writer.update(edits=maps.edits)
    _write_verdict(writer, config, results, late_depth, has_path=maps.has_path)
    _write_counts(writer, maps, results.trajectory)
    observer.on_mapped(Run(writer.folder, config, writer.manifest), results, maps)


def _built(
    writer: RunWriter,
    source: Log,
    trajectory: Trajectory,
    config: BuildConfig,
    progress: Progress,
    *,
    on_snapshot: Callable[[Snapshot | ScanSnapshot], None],
    cached: Path | None,
    edits: Edits,
    checkpoints: Checkpoints | None,
) -> Maps:
    """Build the maps, and keep the frames' updates in the run."""
    make_writer = ScanUpdateWriter if checkpoints is None else partial(MarkedUpdates, checkpoints=checkpoints)
    if checkpoints is not None:
        cached = known_updates(checkpoints, config.octree)
    with (
        open_scan_updates(cached) if cached is not None else nullcontext() as known,
        make_writer(writer.folder / files.SCAN_UPDATES, config.octree) as updates,
    ):
        return build_maps(
            writer.manifest.with_body_rates(source),
            trajectory,
            config,
            progress=progress,
            on_snapshot=on_snapshot,
            cached=known,
            updates=updates,
            edits=edits,
        )


def _write_verdict(
    writer: RunWriter, config: BuildConfig, results: RunResults, late_depth: str, *, has_path: bool
) -> None:
    """Write the warnings of all steps, those of an earlier fuse replaced, and the verdict that they give."""
    found_anew = {FLOOR, DEPTH_TIME} if late_depth else {FLOOR}
    others = [warning for warning in writer.manifest.warnings if warning.kind not in found_anew]
    if late_depth:
        others.append(RunWarning(kind=DEPTH_TIME, sentence=late_depth))
    found = floor_warnings(config.traversable, config.octree.resolution_m, has_path=has_path)
    writer.update(warnings=(*others, *found))
    warnings = find_warnings(results, writer.manifest)
    writer.update(warnings=tuple(warnings), verdict=verdict_of(warnings))


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


def _write_files(folder: Path, maps: Maps) -> None:
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
