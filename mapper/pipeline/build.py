"""From a recorded log to a run folder: track, solve, level, fuse."""

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mapper.config.build import BuildConfig
from mapper.core.deskew import deskewed
from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.core.timebase import check_stamps
from mapper.core.trajectory import Trajectory
from mapper.mapping.body_axes import axes_of
from mapper.mapping.levelling import Level, find_level, level_in_plane
from mapper.mapping.sensor_agreement import mounting_warnings
from mapper.navigation.reachable_floor import MAX_SENSOR_HEIGHT_M
from mapper.odometry.base import Odometry
from mapper.odometry.gyroscope_calibration import with_body_rates
from mapper.odometry.scans.adapted_lengths import adapted_to
from mapper.odometry.scans.config import AnyScanOdometryConfig
from mapper.pipeline.checkpoint_identity import identity_of, kept_from_before
from mapper.pipeline.checkpoints import (
    EVERY_S,
    Checkpoints,
    Step,
    open_checkpoints,
    remove_checkpoints,
)
from mapper.pipeline.component_loops import joined
from mapper.pipeline.disconnected_components import largest_component
from mapper.pipeline.georeference import Georeferenced, georeference
from mapper.pipeline.inertial_bridging import bridge, with_body_readings
from mapper.pipeline.lidar_adjustment import adjust_tracking
from mapper.pipeline.solve import solve
from mapper.pipeline.track import first_session, noted_log_warnings, track_log
from mapper.pipeline.tracking_checkpoints import TrackingCheckpoints
from mapper.pipeline.tracking_result import TrackingResult, from_tracking, refuse_a_fragment, save_places
from mapper.run import files
from mapper.run.folder import Run, open_run
from mapper.run.manifest import Levelling, RunWarning, Solve, Weight
from mapper.run.observers import NULL_OBSERVER, Observer
from mapper.run.stored_tracking import save_solved, save_tracking
from mapper.run.timeline import MAX_SHARE
from mapper.run.verdict import DEPTH_TIME
from mapper.run.writer import RunWriter, first_manifest, write_run
from mapper.runtime.progress import SILENT, Progress
from mapper.sensing.sweep_motion import motion_during
from mapper.sources.base import Log
from mapper.sources.depth_time import depth_time_offset
from mapper.sources.trajectory_files import write_tum
from mapper.sources.vehicle import clear_vehicle


def build(
    source: Log,
    config: BuildConfig,
    out: Path,
    *,
    odometry: Odometry[Any] | Trajectory | None = None,
    progress: Progress = SILENT,
    observer: Observer = NULL_OBSERVER,
    overwrite: bool = False,
    fresh: bool = False,
    checkpoint_s: float | None = EVERY_S,
) -> Run:
    """Track every frame, solve the graph once, level the world, then fuse every frame at its final pose.

    A build that was killed or interrupted is resumed, and ends in the same bytes.

    Args:
        source: The log.
        config: All settings.
        out: Run folder to create; until it is whole it is called ``OUT.partial``.
        odometry: A caller's own, before its first frame, with ``odometry.kind=own``; or poses of the body in
            the log's time, with ``odometry.kind=given``, which the run keeps. None is what the configuration
            chooses.
        progress: Receives stages, counts and notes.
        observer: Receives every tracked frame and the results.
        overwrite: Replace a run that is there, once the new one is whole.
        fresh: Begin anew, even if an unfinished build can be continued.
        checkpoint_s: Seconds between two checkpoints, at least; None makes none, and begins anew, as does a
            caller's own odometry.

    Raises:
        TrackingError: Too few frames could be tracked; what there is stays in ``OUT.partial``.
        DataError: Some frames are from before 1970 or after 2038, which the run's MCAP log cannot hold.
        RunError: OUT is there already, or cannot be made; or a build of another log, with other settings or
            by another version was not finished there.
    """
    check_stamps(source.stamps_ns)
    source, own = clear_vehicle(source, config.source, progress=progress)
    config = config.model_copy(update={"source": own})
    warnings = noted_log_warnings(source, progress)
    poses = odometry if isinstance(odometry, Trajectory) else None
    if odometry is not None and poses is None:
        checkpoint_s = None  # the state of a caller's own class cannot be kept
    identity = identity_of(source, config, poses)
    keeps = partial(kept_from_before, identity=identity, fresh=fresh or checkpoint_s is None)
    with (
        write_run(out, first_manifest(source), config, overwrite=overwrite, keeps=keeps) as writer,
        open_checkpoints(writer, identity, progress, every_s=checkpoint_s) as checkpoints,
    ):
        writer.warn(warnings)
        steps = _Steps(source, config, writer, progress, observer, checkpoints)
        solved: _Solved | None = steps.resume("solved")
        if solved is None:
            tracking: TrackingResult | None = steps.resume("tracked")
            if tracking is None:
                tracking = steps.track(odometry)
            solved = steps.solve(steps.accept(tracking))
        observer.on_levelled(solved.level.T_level_world)
        steps.save(solved, poses)
        steps.fuse()
    remove_checkpoints(out)
    return open_run(out)


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    tracking: TrackingResult
    report: Solve
    level: Level
    georeferenced: Georeferenced


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    source: Log
    config: BuildConfig
    writer: RunWriter
    progress: Progress
    observer: Observer
    checkpoints: Checkpoints | None

    def resume(self, step: Step) -> Any | None:
        """Return the result of a step as an earlier process left it; None if there is none."""
        return None if self.checkpoints is None else self.checkpoints.load(step)

    def track(self, odometry: Odometry[Any] | Trajectory | None) -> TrackingResult:
        """Track every frame, and join the parts of a broken path."""
        with self.writer.clock.stage("track"):
            tracking = track_log(
                self.source,
                self.config,
                progress=self.progress,
                start=first_session(self.source, self.config, odometry),
                observer=self.observer,
                checkpoints=None if self.checkpoints is None else TrackingCheckpoints(self.checkpoints),
            )
            tracking = bridge(self.source, tracking, progress=self.progress)
            tracking = joined(self.source, tracking, self.config, progress=self.progress)
            tracking = largest_component(tracking, progress=self.progress)
        if self.checkpoints is not None:
            self.checkpoints.store("tracked", tracking)
        return tracking

    def accept(self, tracking: TrackingResult) -> TrackingResult:
        """Write the result of tracking, unless too little was tracked for a map."""
        self.writer.warn([*tracking.warnings, *self._late_depth(tracking)])
        save_tracking(self.writer, from_tracking(tracking, self.source))
        if tracking.gyroscope is not None:
            self.writer.record_gyroscope(tracking.gyroscope)
        refuse_a_fragment(
            tracking, self.config, sensor=self.source.sensor, known=self.writer.manifest.warnings
        )
        return tracking

    def _late_depth(self, tracking: TrackingResult) -> list[RunWarning]:
        """Return that depth is late or early, where more frames are not tracked for sure than is harmless."""
        unsure = len(tracking.tracks) - len(tracking.tracked)
        if self.source.sensor != "rgbd" or unsure <= MAX_SHARE * len(tracking.tracks):
            return []
        late = depth_time_offset(self.source, self.config.source)
        return [RunWarning(kind=DEPTH_TIME, sentence=f"depth: {late.text}")] if late.remedy else []

    def solve(self, tracking: TrackingResult) -> _Solved:
        """Solve the graph, keep its largest component, and level the world."""
        with self.writer.clock.stage("solve"):
            graph = solve(tracking.graph, tracking.loops, self.config.graph)
        tracking = replace(tracking, graph=graph.graph, loops=graph.loops)
        tracking = largest_component(tracking, progress=self.progress)
        with self.writer.clock.stage("solve"):
            tracking, planes = adjust_tracking(self.source, tracking, self.config, progress=self.progress)
        with self.writer.clock.stage("level"):
            level = level_of(self.source, tracking, self.config)
            tracking = replace(tracking, graph=tracking.graph.moved(level.T_level_world))
            placed = georeference(tracking, self.source.gnss, self.config.graph)
        level = replace(level, T_level_world=placed.T_map_world @ level.T_level_world)
        if placed.report is not None and placed.report.is_corrected:  # by a solve of the graph alone
            with self.writer.clock.stage("solve"):
                after, planes = adjust_tracking(
                    self.source, placed.tracking, self.config, progress=self.progress
                )
            placed = replace(placed, tracking=after)
        report = graph.report.model_copy(update={"planes": planes})
        solved = _Solved(placed.tracking, report, level, placed)
        if self.checkpoints is not None:
            self.checkpoints.store("solved", solved)
        return solved

    def save(self, solved: _Solved, poses: Trajectory | None) -> None:
        """Write the solved poses, the graph, the places, and the poses that were given."""
        tracking, level = solved.tracking, solved.level
        warnings = []
        if level.conflict:
            weight: Weight = "note" if level.is_decided else "doubt"
            warnings.append(RunWarning(kind="level", sentence=level.conflict, weight=weight))
        if implausible := _height_warning(self.source, tracking.tracked_trajectory()):
            warnings.append(RunWarning(kind="depth", sentence=implausible, weight="doubt"))
        warnings += [
            RunWarning(kind="mounting", sentence=sentence, weight="doubt")
            for sentence in _mounting_warnings(self.source, tracking, self.config)
        ]
        warnings += solved.georeferenced.warnings
        for warning in warnings:
            self.progress.note(warning.text)
        self.writer.warn(warnings)
        with self.writer.clock.stage("solve"):
            save_solved(self.writer, from_tracking(tracking, self.source))
            save_places(self.writer, tracking)
        report = solved.georeferenced.report
        detail = level.detail if report is None else f"{level.detail}; then x was turned to east by GNSS"
        if poses is not None:
            write_tum(self.writer.folder / files.ODOMETRY, poses)
        self.writer.update(
            solve=solved.report,
            levelling=Levelling(method=level.method, detail=detail, has_floor=level.has_floor),
            georeference=report,
        )

    def fuse(self) -> None:
        """Fuse every frame at its final pose."""
        from mapper.pipeline.write_maps import write_maps  # takes long to load: the first frame does not wait

        write_maps(
            self.writer,
            self.source,
            self.config,
            self.progress,
            observer=self.observer,
            checkpoints=self.checkpoints,
        )


def _height_warning(source: Log, trajectory: Trajectory) -> str:
    """Return a sentence about a camera that is implausibly high above the floor; empty if it is not."""
    height_m = float(np.median(trajectory.positions_world[:, 2]))
    if source.sensor != "rgbd" or height_m <= MAX_SENSOR_HEIGHT_M:
        return ""
    return (
        f"the camera is {height_m:.1f} m above the floor; is source.camera.depth_factor right? Of a camera "
        "that is not held upright level.up says which of its axes points up"
    )


def _mounting_warnings(source: Log, tracking: TrackingResult, config: BuildConfig) -> list[str]:
    """Return which sensors beside a LiDAR are not where they are said to be, in a sentence for each."""
    if source.sensor != "lidar" or not source.beside:
        return []
    odometry = adapted_to(config.odometry, source)
    if not isinstance(odometry, AnyScanOdometryConfig):
        return []
    return mounting_warnings(
        with_body_rates(source, tracking.gyroscope), tracking.tracked_trajectory(), voxel_m=odometry.voxel_m
    )


def level_of(source: Log, tracking: TrackingResult, config: BuildConfig) -> Level:
    """Return the level frame of a solved log, found in scans of some of its tracked frames."""
    source = with_body_readings(source, tracking)
    trajectory = tracking.tracked_trajectory()
    scans = _spread_scans(source, trajectory, config.level.frames)
    placed = [
        (
            deskewed(scan, motion_during(scan, trajectory, index, source.gyroscope, source.wheels)),
            trajectory.T_world_body[index],
        )
        for index, scan in scans.items()
    ]
    if source.sensor == "lidar-2d":
        return level_in_plane(
            placed,
            trajectory=trajectory,
            config=config.level,
            axes=axes_of(source, trajectory),
            resolution_m=config.octree.resolution_m,
        )
    return find_level(
        placed,
        trajectory=trajectory,
        accelerations=source.accelerations,
        config=config.level,
        axes=axes_of(source, trajectory),
    )


def _spread_scans(source: Log, trajectory: Trajectory, count: int) -> dict[int, Scan]:
    """Return the scans of a few poses, spread over the trajectory, by the poses' indices."""
    spread = np.unique(np.linspace(0, len(trajectory) - 1, count).round().astype(int))
    index_of = {int(trajectory.stamps_ns[index]): int(index) for index in spread}
    scans = {}
    for entry in source.entries_of(index_of):
        with suppress(FrameError):  # it was readable in the first pass; fusing reports it
            scans[index_of[entry.stamp_ns]] = entry.scan()
    return scans
