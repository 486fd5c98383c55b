"""Fusing: the maps of a finished run made again, after a change of settings, poses or edits."""

import shutil
from dataclasses import replace
from pathlib import Path

from mapper.config.build import BuildConfig
from mapper.core.errors import ConfigError, RunError
from mapper.core.trajectory import Trajectory
from mapper.pipeline.write_maps import write_maps
from mapper.run import files
from mapper.run.edits_file import edits_text, parse_edits, write_edits
from mapper.run.folder import Run, moved_log, open_run
from mapper.run.frame_records import FrameRecord
from mapper.run.input_logs import paths_of, refuse_another_log
from mapper.run.manifest import Solve, Status, Timing
from mapper.run.stored_tracking import StoredTracking, load_tracking, save_solved
from mapper.run.writer import RunWriter, write_run
from mapper.runtime.atomic import is_temporary
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import Log

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
    return fuse_again(source, replace(run, config=config), changed, progress=progress)


def fuse_again(
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
        write_maps(writer, source, run.config, progress, cached=run.scan_updates(), edits=wanted)
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
