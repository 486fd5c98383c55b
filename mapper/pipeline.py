"""From a recorded log to a run folder: the whole story."""

import shutil
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapper import run as files
from mapper.config import BuildConfig
from mapper.deskew import deskewed, twist_at
from mapper.errors import ConfigError, FrameError, RunError
from mapper.export.exporters import EXPORTERS
from mapper.export.grid import write_grid
from mapper.export.mcap_log import McapLog
from mapper.export.picture import write_cloud_views, write_summary
from mapper.export.ply import write_ply
from mapper.fusion import Maps, fuse_log
from mapper.graph.model import PoseGraph
from mapper.levelling import AXES, Level, find_level
from mapper.manifest import Levelling, Solve, Status, Timing
from mapper.measure import peak_memory_mb
from mapper.octree.map_file import write_map
from mapper.octree.octomap_file import write_bt, write_ot
from mapper.octree.sight_file import SightWriter, open_sights
from mapper.parts import largest_part
from mapper.progress import SILENT, Progress
from mapper.run import (
    Draft,
    Run,
    drafting,
    first_manifest,
    load_run,
    moved_log,
    paths_of,
    refuse_another_log,
)
from mapper.run_log import log_maps, log_snapshot, log_story
from mapper.solving import solve
from mapper.sources.base import FrameSource
from mapper.story import Story, story_of
from mapper.timebase import NS_PER_S
from mapper.tracked import Tracked, save_tracked, tracked_before, tracked_now
from mapper.tracking import refuse_a_fragment, track_log
from mapper.trajectory import Trajectory
from mapper.watching import NOBODY, Watcher

_FUSE_CONFIGS = frozenset(
    {"octree", "slice", "traversable", "cloud", "mcap", "mesh", "costmap", "rerun", "workers"}
)
_TRACKING_STAGES = ("track", "solve", "level")
_REMADE_BY_FUSE = frozenset(
    {
        files.CONFIG,
        files.MANIFEST,
        files.OCTREE_BT,
        files.OCTREE_OT,
        files.OCTREE_MAP,
        files.SIGHTS,
        files.CLOUD,
        files.CLOUD_VIEWS,
        files.MCAP,
        files.SUMMARY,
    }
)
_OUTDATED_BY_FUSE = frozenset(
    {
        *(EXPORTERS[kind].file_name for kind in ("voxels", "voxel-mesh", "costmap", "foxglove-layout")),
        *(f"{files.COSTMAP}{ending}" for ending in EXPORTERS["costmap"].beside),
        files.PLAN,
        files.PLAN_VIEW,
        files.RERUN,
    }
)


def build(
    source: FrameSource,
    config: BuildConfig,
    out: Path,
    *,
    progress: Progress = SILENT,
    watcher: Watcher = NOBODY,
    overwrite: bool = False,
) -> Run:
    """Track every frame, solve the graph once, level the world, then fuse every frame at its final pose.

    Args:
        source: The log.
        config: Every knob.
        out: Run folder to create; until it is whole it is called ``OUT.partial``.
        progress: Who waits.
        watcher: Who looks on.
        overwrite: Replace a run that is there, once the new one is whole.

    Raises:
        TrackingError: Too few frames could be tracked; what there is stays in ``OUT.partial``.
        RunError: OUT is there already, or cannot be made.
    """
    with drafting(out, first_manifest(source), config, overwrite=overwrite) as draft:
        with draft.clock.stage("track"):
            tracking = track_log(source, config, progress=progress, watcher=watcher)
            tracking = largest_part(tracking, progress=progress)
        save_tracked(draft, tracked_now(tracking, source.truth))
        refuse_a_fragment(tracking, config, sensor=source.sensor)
        with draft.clock.stage("solve"):
            solved = solve(tracking.graph, tracking.loops, config.graph)
        tracking = replace(tracking, graph=solved.graph, loops=solved.loops)
        tracking = largest_part(tracking, progress=progress)
        with draft.clock.stage("level"):
            level = _level(source, tracking.trajectory(), config)
        watcher.levelled(level.T_level_world)
        tracking = replace(tracking, graph=tracking.graph.moved(level.T_level_world))
        save_tracked(draft, tracked_now(tracking, source.truth))
        draft.update(
            solve=solved.report,
            levelling=Levelling(method=level.method, detail=level.detail),
        )
        fuse_into(draft, source, config, progress, watcher=watcher)
    return load_run(out)


def fuse(
    source: FrameSource,
    run: Run,
    config: BuildConfig,
    *,
    trajectory: Trajectory | None = None,
    progress: Progress = SILENT,
) -> Run:
    """Make a run's maps again, with another octree, slice, cloud or MCAP configuration or along other poses.

    What a frame saw is taken from the old run where pose and rays are the same; the maps are those of fusing
    everything from scratch. The run stays as it is until the new maps are whole, and files that are not ours
    stay in it.

    Args:
        source: The log that the run was built from.
        run: A finished run.
        config: The run's own configuration with the map's knobs turned.
        trajectory: Body poses in the levelled world by which to replace the run's; None keeps those.
        progress: Who watches.

    Raises:
        ConfigError: The configuration differs in something that tracking has already settled.
        RunError: The log is not the one that the run was built from, or the trajectory has no frame of it.
    """
    for name in sorted(set(BuildConfig.model_fields) - _FUSE_CONFIGS):
        if getattr(config, name) != getattr(run.config, name):
            raise ConfigError(f"{name}: fuse keeps what was tracked and cannot change it; run mapper build")
    changed = None if trajectory is None else _led_along(run, trajectory)
    return fuse_changed(source, replace(run, config=config), changed, progress=progress)


def fuse_changed(
    source: FrameSource,
    run: Run,
    changed: Tracked | None = None,
    *,
    solve: Solve | None = None,
    progress: Progress = SILENT,
) -> Run:
    """Make a run's maps again after its graph or its poses have changed; see ``fuse``.

    Args:
        source: The log that the run was built from.
        run: A finished run, with the configuration to fuse by.
        changed: What replaces the run's own; None keeps that.
        solve: What the manifest says of the solve that changed it; None keeps what it says.
        progress: Who watches.

    Raises:
        RunError: The log is not the one that the run was built from.
    """
    refuse_another_log(run, source)
    status: Status = "building"
    manifest = moved_log(run, *paths_of(source)).manifest.model_copy(update={"status": status})
    with drafting(run.path, manifest, run.config, overwrite=True) as draft:
        carry_times(draft, manifest.timing)
        _keep_the_rest(run.path, draft.folder)
        if changed is not None:
            save_tracked(draft, changed)
            (draft.folder / EXPORTERS["mesh"].file_name).unlink(missing_ok=True)
        if solve is not None:
            draft.update(solve=solve)
        fuse_into(draft, source, run.config, progress, before=run.path / files.SIGHTS)
    return load_run(run.path)


def carry_times(draft: Draft, timing: Timing) -> None:
    """Count the time that tracking took in an earlier run as this one's."""
    for stage in _TRACKING_STAGES:
        draft.clock.seconds[stage] = timing.stage_s[stage]


def _led_along(run: Run, trajectory: Trajectory) -> Tracked:
    """Return what a run keeps, with its trajectory replaced and the nodes of its graph moved along."""
    tracked = tracked_before(run)
    T_world_body = dict(zip(trajectory.stamps_ns.tolist(), trajectory.T_world_body, strict=True))
    if T_world_body.keys().isdisjoint(tracked.trajectory.stamps_ns.tolist()):
        raise RunError(f"{run.path}: none of the trajectory's {len(trajectory)} stamps is one of the run's")
    graph = tracked.graph
    moved = {node: T_world_body.get(graph.stamps_ns[node], T) for node, T in graph.T_world_node.items()}
    return replace(tracked, trajectory=trajectory, graph=PoseGraph(moved, graph.stamps_ns, graph.factors))


def _keep_the_rest(folder: Path, new: Path) -> None:
    """Copy what was tracked, and whatever a user has put there; what was made from the old maps goes."""
    for child in folder.iterdir():
        if child.name in _REMADE_BY_FUSE | _OUTDATED_BY_FUSE:
            continue
        if child.is_dir() and not child.is_symlink():
            shutil.copytree(child, new / child.name, symlinks=True)
        else:
            shutil.copy2(child, new / child.name, follow_symlinks=False)


def _level(source: FrameSource, trajectory: Trajectory, config: BuildConfig) -> Level:
    """Find the level frame from a few frames, spread over the trajectory."""
    spread = np.unique(np.linspace(0, len(trajectory) - 1, config.level.frames).round().astype(int))
    index_of = {int(trajectory.stamps_ns[index]): int(index) for index in spread}
    scans = []
    for entry in source.entries():
        if entry.stamp_ns in index_of:
            index = index_of[entry.stamp_ns]
            try:
                scan = deskewed(entry.scan(), twist_at(trajectory, index))
            except FrameError:
                continue  # it was readable a moment ago; the second pass will tell
            scans.append((scan, trajectory.T_world_body[index]))
    return find_level(
        scans,
        trajectory=trajectory,
        accelerations=source.accelerations,
        config=config.level,
        axes=AXES[source.sensor],
    )


def fuse_into(
    draft: Draft,
    source: FrameSource,
    config: BuildConfig,
    progress: Progress,
    *,
    before: Path | None = None,
    watcher: Watcher = NOBODY,
) -> None:
    """Fuse a draft's trajectory and write everything that is made from the maps."""
    story = story_of(Run(draft.folder, config, draft.manifest))
    if not config.mcap.frame_times:
        story = replace(story, frame_ms={})
    trajectory = story.trajectory
    with McapLog(draft.folder / files.MCAP) as log:
        with (
            draft.clock.stage("fuse"),
            open_sights(before) if before is not None and before.exists() else nullcontext() as known,
            SightWriter(draft.folder / files.SIGHTS, config.octree) as sights,
        ):
            maps = fuse_log(
                source,
                trajectory,
                config,
                progress=progress,
                on_snapshot=lambda snapshot: log_snapshot(log, snapshot),
                before=known,
                after=sights,
            )
        with draft.clock.stage("write"):
            log_story(log, story)
            log_maps(log, maps, stamp_ns=int(trajectory.stamps_ns[0]))
            _write_maps(draft.folder, maps)
            _write_pictures(draft, maps, story)
    counts = draft.manifest.counts.model_copy(
        update={"leaves": len(maps.octree), "cloud_points": len(maps.cloud_points_world)}
    )
    draft.update(counts=counts, timing=_timing(draft, trajectory, counts.read))
    watcher.mapped(Run(draft.folder, config, draft.manifest), story, maps)


def _write_maps(folder: Path, maps: Maps) -> None:
    write_bt(folder / files.OCTREE_BT, maps.octree)
    write_ot(folder / files.OCTREE_OT, maps.octree)
    write_map(folder / files.OCTREE_MAP, maps.octree)
    write_ply(folder / files.CLOUD, maps.cloud_points_world, maps.cloud_colors)
    write_grid(folder, files.SLICE, maps.grid)
    write_grid(folder, files.TRAVERSABLE, maps.traversable)


def _write_pictures(draft: Draft, maps: Maps, story: Story) -> None:
    counts, levelling = draft.manifest.counts, draft.manifest.levelling
    trajectory, graph = story.trajectory, story.graph
    lines = [f"{len(trajectory)} frames, {counts.nodes} keyframes, {trajectory.path_length_m:.2f} m of path"]
    if levelling is not None:
        lines.append(f"levelled by {levelling.method}")
    write_summary(
        draft.folder / files.SUMMARY,
        grid=maps.grid,
        trajectory=trajectory,
        truth=story.truth,
        loops_world=np.array(
            [
                [graph.T_world_node[node][:3, 3] for node in (factor.i, factor.j)]
                for factor in graph.factors
                if factor.origin == "loop"
            ]
        ).reshape(-1, 2, 3),
        title=draft.manifest.input.title,
        lines=lines,
    )
    if len(maps.cloud_points_world):
        write_cloud_views(
            draft.folder / files.CLOUD_VIEWS, maps.cloud_points_world, maps.cloud_colors, trajectory
        )


def _duration_s(trajectory: Trajectory, begins_ns: Sequence[int]) -> float:
    """Return the seconds from first to last frame, without the pauses before logs that begin later."""
    sessions = np.split(trajectory.stamps_ns, np.searchsorted(trajectory.stamps_ns, begins_ns))
    return float(sum(stamps[-1] - stamps[0] for stamps in sessions if len(stamps))) / NS_PER_S


def _timing(draft: Draft, trajectory: Trajectory, frames: int) -> Timing:
    seconds = {stage: round(value, 3) for stage, value in draft.clock.seconds.items()}
    total_s = sum(seconds.values())
    log_s = _duration_s(trajectory, [log.begins_ns for log in draft.manifest.input.appended])
    return draft.manifest.timing.model_copy(
        update={
            "stage_s": seconds,
            "total_s": round(total_s, 3),
            "log_s": log_s,
            "frames_per_s": round(frames / total_s, 2),
            "real_time_factor": round(log_s / total_s, 3),
            "peak_memory_mb": round(max(peak_memory_mb(), draft.manifest.timing.peak_memory_mb), 1),
        }
    )
