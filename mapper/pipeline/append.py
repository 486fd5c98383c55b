"""Appending: a second session of the same place, connected to the first by loops and mapped with it."""

from collections.abc import Sequence, Set
from dataclasses import replace
from pathlib import Path

from mapper.config.build import BuildConfig
from mapper.core.errors import ConfigError, LoopError
from mapper.core.geometry import inverse
from mapper.loops.closure import LoopClosure, accepted_loops, why_none_accepted
from mapper.loops.config import KeyframeLoopsConfig
from mapper.loops.factory import build_keyframe_loop_detector
from mapper.odometry.base import FrameResult
from mapper.odometry.gyroscope_calibration import with_body_rates
from mapper.pipeline.component_loops import joined
from mapper.pipeline.disconnected_components import component_of
from mapper.pipeline.fuse import carry_times
from mapper.pipeline.inertial_bridging import bridge
from mapper.pipeline.lidar_adjustment import adjust_stored
from mapper.pipeline.reobserve import reobserve
from mapper.pipeline.solve import solve
from mapper.pipeline.track import Start, noted_log_warnings, session_odometry, track_log
from mapper.pipeline.tracking_result import TrackingResult, from_tracking, refuse_a_fragment, save_places
from mapper.pipeline.write_maps import write_maps
from mapper.run.edits_file import edits_text, parse_edits, write_edits
from mapper.run.folder import Run, open_run
from mapper.run.manifest import Manifest, Timing, library_versions, now_text
from mapper.run.observers import NULL_OBSERVER, Observer
from mapper.run.stored_tracking import StoredTracking, load_tracking, save_solved
from mapper.run.verdict import INPUT_KINDS
from mapper.run.writer import appended_log, write_run
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.multi_session_log import chained
from mapper.sources.vehicle import clear_vehicle

_FIXED_BY_FIRST_SESSION = ("odometry", "level")


def append(
    second: Log,
    run: Run,
    config: BuildConfig,
    out: Path,
    *,
    progress: Progress = SILENT,
    observer: Observer = NULL_OBSERVER,
    overwrite: bool = False,
) -> Run:
    """Track a log as a later session of a run's place, solve both as one graph, and map them together.

    The run stays as it is, and the new one has its world: the first node of the first session does not move.
    No drift gate holds between the sessions until loops connect them; the other tests do.

    Args:
        second: The later log.
        run: A finished run; its log must be there still, since its keyframes are observed again.
        config: The run's own but for what may differ: ``source`` is the second log's, and loops, solver and
            map may have other settings.
        out: Run folder to create.
        progress: Receives stages, counts and notes.
        observer: Receives every tracked frame of the later log, and the results.
        overwrite: Replace a run that is there, once the new one is whole.

    Raises:
        ConfigError: The configuration cannot join sessions, or differs in what the first session fixes.
        TrackingError: Too few frames could be tracked.
        LoopError: No loop connects the two sessions.
        RunError: OUT is there already, or the run's log is not what it was.
    """
    _refuse_unfit(config, run)
    edits = edits_text(run.path)
    wanted = parse_edits(edits, run.path)
    first = run.open_log()
    second, own = clear_vehicle(second, config.source)
    config = config.model_copy(update={"source": own})
    source = chained(first, second)
    for note in source.sentences:
        progress.note(note)
    warnings = noted_log_warnings(second, progress)
    whole = config.model_copy(update={"source": run.config.source})
    with write_run(out, _manifest(run, source, config.source), whole, overwrite=overwrite) as writer:
        carry_times(writer, run.manifest.timing)
        before = load_tracking(run)
        known = before.graph.T_world_node.keys()
        with writer.clock.stage("track"):
            session = source.sessions[-1].log
            start = _after(before, first, session, config, progress)
            tracking = track_log(session, config, progress=progress, start=start, observer=observer)
            tracking = bridge(session, tracking, progress=progress)
            tracking = _joined(source, before, tracking, config, progress)
        if tracking.gyroscope is not None:
            writer.record_gyroscope(tracking.gyroscope)
            source = chained(first, with_body_rates(second, tracking.gyroscope))
        writer.warn([*warnings, *tracking.warnings])
        refuse_a_fragment(tracking, config, sensor=source.sensor, known=writer.manifest.warnings)
        _refuse_unconnected(second, run, tracking.loops, known)
        with writer.clock.stage("solve"):
            tracking = component_of(tracking, next(iter(known)), progress=progress)
            solved = solve(tracking.graph, tracking.loops, config.graph)
        _refuse_unconnected(second, run, solved.loops, known)
        later = from_tracking(replace(tracking, graph=solved.graph, loops=solved.loops), session)
        both = before.solved(solved.graph, solved.loops).then(later, truth=source.truth)
        rotating = writer.manifest.with_body_rates(source)
        with writer.clock.stage("solve"):
            both, report = adjust_stored(rotating, both, solved.report, config, progress=progress)
        save_places(writer, tracking)
        save_solved(writer, both)
        writer.update(solve=report)
        write_edits(writer.folder, edits)
        write_maps(
            writer, source, whole, progress, observer=observer, cached=run.scan_updates(), edits=wanted
        )
    return open_run(out)


def _refuse_unfit(config: BuildConfig, run: Run) -> None:
    for name in _FIXED_BY_FIRST_SESSION:
        if getattr(config, name) != getattr(run.config, name):
            raise ConfigError(f"{name}: fixed by {run.path}; a session is appended with the same settings")
    if not isinstance(config.loops, KeyframeLoopsConfig):
        raise ConfigError(
            f"loops.kind={config.loops.kind}: cannot connect two sessions; want places or scans"
        )
    if config.graph.solve != "batch":
        raise ConfigError(f"graph.solve={config.graph.solve}: cannot join two sessions; want batch")


def _manifest(run: Run, source: Log, config: SourceConfig) -> Manifest:
    """Return the manifest to begin with: the first session's, without what is measured again of both."""
    known = run.manifest.input
    appended = (*known.appended, appended_log(source.sessions[-1], config))
    return Manifest(
        status="building",
        libraries=library_versions(),
        input=known.model_copy(update={"appended": appended}),
        levelling=run.manifest.levelling,
        georeference=run.manifest.georeference,
        gyroscope=run.manifest.gyroscope,
        warnings=tuple(warning for warning in run.manifest.warnings if warning.kind in INPUT_KINDS),
        timing=Timing(started=now_text()),
    )


def _after(
    before: StoredTracking,
    first: Log,
    session: Log,
    config: BuildConfig,
    progress: Progress,
) -> Start:
    """Return the start of a session, with the places of the earlier one preloaded."""
    assert isinstance(config.loops, KeyframeLoopsConfig)
    graph = before.graph
    detector = build_keyframe_loop_detector(config.loops, config.graph.solve)
    views = reobserve(first, before.trajectory, set(graph.stamps_ns.values()), config, progress=progress)
    detector.preload(graph, {node: views[stamp_ns] for node, stamp_ns in graph.stamps_ns.items()})
    return Start(session_odometry(session, config), detector, graph.without_loops(), before.loops)


def _joined(
    source: Log, before: StoredTracking, tracking: TrackingResult, config: BuildConfig, progress: Progress
) -> TrackingResult:
    """Return a session with loops to the earlier ones by images from near and far, where no others are."""
    poses = dict(before.trajectory.items())
    known = [
        FrameResult(
            stamp_ns=record.stamp_ns,
            node=record.node,
            T_node_body=inverse(before.graph.T_world_node[record.node]) @ T_world_body,
            T_world_body=T_world_body,
            is_keyframe=record.is_keyframe,
            diagnostics=record.diagnostics,
            doubts=record.doubts,
        )
        for record in before.records
        if record.node is not None and (T_world_body := poses.get(record.stamp_ns)) is not None
    ]
    both = replace(tracking, tracks=(*known, *tracking.tracks))
    return replace(joined(source, both, config, progress=progress), tracks=tracking.tracks)


def _refuse_unconnected(second: Log, run: Run, loops: Sequence[LoopClosure], known: Set[int]) -> None:
    between = [loop for loop in loops if loop.i in known and loop.j not in known]
    if accepted_loops(between):
        return
    why = why_none_accepted(between)
    raise LoopError(f"{second.path}: no loop connects it to {run.path}; {why}; is it the same place?")
