"""Localising: a new log placed in a finished map, which stays as it is."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress, groupby, pairwise, product
from pathlib import Path

import numpy as np

from mapper.config.build import BuildConfig
from mapper.core.doubts import Doubt
from mapper.core.errors import ConfigError, LoopError
from mapper.core.geometry import Transform, distances_along, inverse
from mapper.core.timebase import NS_PER_S
from mapper.export.picture import write_localised
from mapper.graph.components import component_numbers, components
from mapper.graph.config import GraphConfig
from mapper.graph.measurement_covariance import MEDIAN_CHI2
from mapper.graph.model import PoseGraph
from mapper.graph.optimize import optimize
from mapper.loops.closure import (
    LEAST_AGREEING,
    SOLVER,
    Discrepancy,
    accepted_loops,
    exceeds,
    pose_difference,
    why_none_accepted,
)
from mapper.loops.config import SLACK_RAD, GateConfig, PlaceLoopsConfig, ScanLoopsConfig
from mapper.loops.map_constraints import build_map_constraint_detector
from mapper.loops.odometry_drift import NodePath, allowed
from mapper.pipeline.disconnected_components import component_of, disconnected
from mapper.pipeline.known_map import KnownMap, detector_of, loops_between_days
from mapper.pipeline.solve import solve
from mapper.pipeline.track import Start, noted_log_warnings, session_odometry, track_log
from mapper.pipeline.tracking_result import TrackingResult, from_tracking
from mapper.run import files
from mapper.run.frame_records import FrameRecord
from mapper.run.manifest import LocalisedManifest, Solve, Stretch, StretchState
from mapper.run.pose_covariances import UncertainPoses, uncertain_poses, write_poses
from mapper.run.results import RunResults
from mapper.run.stored_tracking import save_frames
from mapper.run.verdict import localisation_warnings, verdict_of
from mapper.run.writer import RunWriter, first_manifest, write_run
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import Log

_WINDOW = 5
"""Constraints on either side of a jump that are compared."""
_MAX_ACROSS, _MIN_WITHIN = 0.2, 0.6
"""Shares of the pairs that agree: across a jump few do, on either side of it most."""


@dataclass(frozen=True, slots=True, eq=False)
class _Constrained:
    """A node with its pose by the map, its pose by odometry, and the metres and radians of path before it."""

    node: int
    T_map_node: Transform
    T_odometry_node: Transform
    path: NodePath


def without_jumps(
    tracking: TrackingResult, map_node: int, gate: GateConfig, *, progress: Progress
) -> TrackingResult:
    """Return the result with the odometry cut where the map shows that the sensor was carried elsewhere.

    Several constraints before a jump agree with each other along the odometry, and so do several after it,
    but hardly any before agrees with one after. What lies between the last before and the first after is left
    out.

    Args:
        tracking: Tracking result with constraints from the map's node.
        map_node: That node.
        gate: Drift that the odometry may have.
        progress: Receives a note on each cut.
    """
    graph = tracking.graph
    for nodes in components(graph.without_loops()):
        for last, first in _jumps(_constrained(tracking, sorted(nodes)), gate):
            times_s = [
                (graph.stamps_ns[node] - tracking.tracks[0].stamp_ns) / NS_PER_S for node in (last, first)
            ]
            progress.note(
                f"between {times_s[0]:.1f} and {times_s[1]:.1f} s the path jumps in the map: the odometry is "
                "cut there"
            )
            tracking = _cut(tracking, last, first, map_node)
    return tracking


def _constrained(tracking: TrackingResult, nodes: Sequence[int]) -> list[_Constrained]:
    T_odometry = tracking.graph.T_world_node
    T_map_node = {
        loop.j: loop.T_i_j for loop in tracking.loops if loop.verdict == "accepted" and loop.T_i_j is not None
    }
    found, path_m, turned_rad = [], 0.0, 0.0
    for before, node in zip([nodes[0], *nodes], nodes, strict=False):
        step = pose_difference(T_odometry[before], T_odometry[node])
        path_m, turned_rad = path_m + step.translation_m, turned_rad + step.rotation_rad
        if node in T_map_node:
            path = NodePath(path_m, turned_rad)
            found.append(_Constrained(node, T_map_node[node], T_odometry[node], path))
    return found


def _jumps(constrained: Sequence[_Constrained], gate: GateConfig) -> list[tuple[int, int]]:
    """Return the last node before every jump and the first after it."""
    best, least = None, _MAX_ACROSS
    for k in range(LEAST_AGREEING, len(constrained) - LEAST_AGREEING + 1):
        before, after = constrained[max(k - _WINDOW, 0) : k], constrained[k : k + _WINDOW]
        across = float(np.mean([_agree(a, b, gate) for a, b in product(before, after)]))
        if across < least and min(_within(before, gate), _within(after, gate)) >= _MIN_WITHIN:
            best, least = k, across
    if best is None:
        return []
    jump = constrained[best - 1].node, constrained[best].node
    return [*_jumps(constrained[:best], gate), jump, *_jumps(constrained[best:], gate)]


def _within(side: Sequence[_Constrained], gate: GateConfig) -> float:
    return float(np.mean([_agree(a, b, gate) for a, b in pairwise(side)]))


def _agree(a: _Constrained, b: _Constrained, gate: GateConfig) -> bool:
    T_map_b = a.T_map_node @ inverse(a.T_odometry_node) @ b.T_odometry_node
    path = NodePath(b.path.path_m - a.path.path_m, b.path.turned_rad - a.path.turned_rad)
    return not exceeds(pose_difference(T_map_b, b.T_map_node), allowed(gate, path))


def _cut(tracking: TrackingResult, last: int, first: int, map_node: int) -> TrackingResult:
    graph = tracking.graph
    kept = (
        factor
        for factor in graph.factors
        if factor.i == map_node or max(factor.i, factor.j) <= last or min(factor.i, factor.j) >= first
    )
    begin_ns, end_ns = graph.stamps_ns[last], graph.stamps_ns[first]
    return replace(
        tracking,
        graph=graph.with_factors(kept),
        tracks=tuple(
            disconnected(track) if begin_ns < track.stamp_ns < end_ns else track for track in tracking.tracks
        ),
    )


_STATES: Mapping[str, StretchState] = {"tracked": "localised", "doubtful": "doubtful"}
_FAR, _FAR_BEYOND = 3.0, 0.2
"""Distances along the path to the nearest constraint beyond which a frame is doubtful, as factors on
``loops.agreement_path_m``: between two constraints, and with one on one side only, which hides a jump."""


def localise(
    source: Log,
    known: KnownMap,
    config: BuildConfig,
    out: Path,
    *,
    progress: Progress = SILENT,
    overwrite: bool = False,
) -> LocalisedManifest:
    """Place a log in a finished map: its poses in the map's frame, with their covariance given the map.

    The log is tracked as in a build. Its keyframes are compared with the map's places, and what holds becomes
    a constraint to the map's frame, one node that is fixed; odometry and constraints are solved together, so
    between constraints the odometry carries on. A part of the path without constraints is not localised.

    Args:
        source: The log.
        known: The finished map.
        config: The map's own; all but the detector of features may have other settings.
        out: Folder to create.
        progress: Receives stages, counts and notes.
        overwrite: Replace a folder that is there, once the new one is whole.

    Raises:
        ConfigError: The log is of another sensor than the map, or the settings differ in what places were
            observed by.
        LoopError: Nothing of the log can be placed; the message says why.
        RunError: OUT is there already.
    """
    _refuse_unfit(source, known, config)
    warnings = noted_log_warnings(source, progress)
    start = first_manifest(source)
    manifest = LocalisedManifest(map=str(known.path.resolve()), **dict(start))
    with write_run(out, manifest, config, overwrite=overwrite, kind=files.LOCALISED_LOG) as writer:
        writer.warn(warnings)
        with writer.clock.stage("track"):
            tracking = track_log(source, config, progress=progress, start=_start(source, known, config))
        writer.warn(tracking.warnings)
        with writer.clock.stage("solve"):
            tracking, report = _solved_in_map(source, known, tracking, config, progress)
        writer.update(solve=report)
        with writer.clock.stage("write"):
            _write(writer, source, known, tracking)
    finished = writer.manifest
    assert isinstance(finished, LocalisedManifest)  # as it began
    return finished


def _refuse_unfit(source: Log, known: KnownMap, config: BuildConfig) -> None:
    if source.sensor != known.sensor:
        raise ConfigError(
            f"{source.path}: is of sensor {source.sensor}, and the places of {known.path} were seen by "
            f"{known.sensor}; want a log of the map's sensor"
        )
    if detector_of(config) != detector_of(known.config):
        raise ConfigError(
            f"odometry.detector: fixed by {known.path}; its places have the features of that detector"
        )
    if config.graph.solve != "batch":
        raise ConfigError(f"graph.solve={config.graph.solve}: cannot join a log to a map; want batch")


def _start(source: Log, known: KnownMap, config: BuildConfig) -> Start:
    map_node = known.places.map_node
    detector = build_map_constraint_detector(loops_between_days(config.loops, source.sensor), known.places)
    graph = PoseGraph({map_node: np.eye(4)}, {map_node: 0})
    return Start(session_odometry(source, config), detector, graph)


def _solved_in_map(
    source: Log, known: KnownMap, tracking: TrackingResult, config: BuildConfig, progress: Progress
) -> tuple[TrackingResult, Solve]:
    """Return the part of a tracked log that constraints tie to the map, at its solution, and its record."""
    map_node, loops = known.places.map_node, loops_between_days(config.loops, source.sensor)
    tracking = _supported(without_jumps(tracking, map_node, loops.gate, progress=progress))
    _refuse_unplaced(source, known, tracking)
    solved = solve(tracking.graph, tracking.loops, config.graph)
    tracking = _supported(replace(tracking, graph=solved.graph, loops=solved.loops))
    _refuse_unplaced(source, known, tracking)
    tracking = component_of(tracking, map_node, progress=progress)
    tracking = replace(tracking, graph=_with_scaled_constraints(tracking.graph, config.graph))
    return _doubtful_unless_confirmed(tracking, loops), solved.report


def _refuse_unplaced(source: Log, known: KnownMap, tracking: TrackingResult) -> None:
    if accepted_loops(tracking.loops):
        return
    why = why_none_accepted(tracking.loops)
    raise LoopError(f"{source.path}: cannot be placed in {known.path}; {why}; is it the same place?")


def _supported(tracking: TrackingResult) -> TrackingResult:
    """Return the result without the constraints of parts that too few tie to the map."""
    part_of = component_numbers(tracking.graph.without_loops())
    tied = Counter(part_of[loop.j] for loop in accepted_loops(tracking.loops))
    weak = {part for part, count in tied.items() if count < LEAST_AGREEING}
    if not weak:
        return tracking
    loops = tuple(
        loop.rejected(
            "few", f"{tied[part_of[loop.j]]} constraints tie its part of the path, want {LEAST_AGREEING}"
        )
        if loop.verdict == "accepted" and part_of[loop.j] in weak
        else loop
        for loop in tracking.loops
    )
    graph = tracking.graph.with_loops(loop.factor for loop in accepted_loops(loops))
    return replace(tracking, graph=graph, loops=loops)


def _with_scaled_constraints(graph: PoseGraph, config: GraphConfig) -> PoseGraph:
    """Return the graph solved again, with the constraints' information scaled to how well they agree.

    Their information is that of the pixels or points, without the errors of the map's own poses. These are
    included by dividing it by the ratio of their median χ² to that of consistent measurements.
    """
    exact = config.model_copy(update={"robust": "none"})
    solution = optimize(graph, exact)
    is_constraint = [factor.origin == "loop" for factor in graph.factors]
    chi2 = 2.0 * np.array(solution.factor_errors)[is_constraint]
    scale = 1.0 / max(1.0, float(np.median(chi2)) / MEDIAN_CHI2)
    constraints = compress(graph.factors, is_constraint)
    scaled = [replace(factor, information=scale * factor.information) for factor in constraints]
    graph = graph.with_poses(solution.T_world_node).with_loops(scaled)
    return graph.with_poses(optimize(graph, exact).T_world_node)


def _doubtful_unless_confirmed(
    tracking: TrackingResult, loops: PlaceLoopsConfig | ScanLoopsConfig
) -> TrackingResult:
    """Return the result with the frames doubtful whose pose no constraint nearby confirms.

    Between two constraints that the odometry agrees with, it has neither drifted far nor jumped. Before the
    first and after the last constraint of a part of the path nothing shows this, least of all where the map
    was searched in vain.
    """
    graph, doubts = tracking.graph, dict[int, Doubt]()
    held = {loop.j for loop in accepted_loops(tracking.loops)}
    failed = {loop.j for loop in tracking.loops} - held
    for nodes in components(graph.without_loops()):
        if not held.isdisjoint(nodes):
            doubts |= _unconfirmed(graph, sorted(nodes), held, failed, loops.agreement_path_m)
    slack = Discrepancy(loops.gate.slack_m, SLACK_RAD)
    contradicting = {
        loop.j
        for loop in tracking.loops
        if loop.rejected_by == SOLVER and loop.after is not None and exceeds(loop.after, slack)
    } - held
    contradicted = Doubt("disagreement", "the place that was recognised here contradicts the others")
    doubts |= dict.fromkeys(contradicting, contradicted)
    tracks = tuple(
        replace(track, doubts=(*track.doubts, doubts[track.node])) if track.node in doubts else track
        for track in tracking.tracks
    )
    return replace(tracking, tracks=tracks)


def _unconfirmed(
    graph: PoseGraph, nodes: Sequence[int], held: set[int], failed: set[int], path_m: float
) -> dict[int, Doubt]:
    """Return the doubts about the nodes of one part of the path that no constraint nearby confirms.

    Args:
        graph: The graph at its solution.
        nodes: Nodes of the part, in order.
        held: Nodes with a constraint that holds, some of them in this part.
        failed: Nodes from which the map was searched in vain.
        path_m: Length of path over which two constraints are compared.
    """
    positions = np.array([graph.T_world_node[node] for node in nodes])[:, :3, 3]
    reached_m = distances_along(positions)
    known = sorted(held.intersection(nodes))
    known_m = reached_m[np.searchsorted(nodes, known)]
    begin = max((node for node in failed.intersection(nodes) if node < known[0]), default=-1)
    end = min((node for node in failed.intersection(nodes) if node > known[-1]), default=nodes[-1] + 1)
    doubts = {}
    for node, at_m in zip(nodes, reached_m.tolist(), strict=True):
        is_between = known[0] <= node <= known[-1]
        limit_m = path_m * (_FAR if is_between else _FAR_BEYOND)
        if not begin < node < end:
            text = "the map was searched in vain here, at the end of what was recognised"
            doubts[node] = Doubt("unconfirmed", text)
        elif np.abs(known_m - at_m).min() > limit_m:
            text = f"more than {limit_m:g} m of path from the nearest place that was recognised"
            doubts[node] = Doubt("unconfirmed", text)
    return doubts


def _write(writer: RunWriter, source: Log, known: KnownMap, tracking: TrackingResult) -> None:
    folder, held = writer.folder, accepted_loops(tracking.loops)
    stored = from_tracking(tracking, source)
    poses = uncertain_poses(stored.trajectory, stored.graph, stored.records)
    save_frames(writer, stored, nodes=len(stored.graph.T_world_node) - 1)
    write_poses(folder / files.POSES, poses)
    counts = writer.manifest.counts
    writer.update(
        stretches=tuple(_stretches(stored.records, poses, [loop.stamp_j_ns for loop in held])),
    )
    results = RunResults(stored.trajectory, stored.graph, stored.records, held, stored.frame_ms, None, poses)
    warnings = localisation_warnings(results, writer.manifest)
    writer.update(warnings=tuple(warnings), verdict=verdict_of(warnings))
    write_localised(
        folder / files.SUMMARY,
        grid=known.slice,
        poses=poses,
        begins_ns=[record.stamp_ns for record in stored.records if record.node is None],
        recognised_world=np.array([stored.graph.T_world_node[loop.j][:3, 3] for loop in held]),
        title=f"{source.path.name} in {known.path.name}",
        lines=[counts.frames_text],
    )
    writer.record_timing(log_s=float(np.ptp(source.stamps_ns)) / NS_PER_S, frames=counts.read)


def _stretches(
    records: Sequence[FrameRecord], poses: UncertainPoses, recognised_ns: Sequence[int]
) -> Iterator[Stretch]:
    """Yield a log's stretches in time order, with how many of their keyframes were recognised in the map."""
    stamps_ns, constrained_ns = poses.trajectory.stamps_ns, np.array(recognised_ns, np.int64)
    for state, group in groupby(records, key=lambda record: _STATES.get(record.outcome, "not localised")):
        frames = list(group)
        first_ns, last_ns = frames[0].stamp_ns, frames[-1].stamp_ns
        sigmas_m = poses.position_sigmas_m[(stamps_ns >= first_ns) & (stamps_ns <= last_ns)]
        known = sigmas_m[np.isfinite(sigmas_m)]
        yield Stretch(
            state=state,
            begin_s=(first_ns - records[0].stamp_ns) / NS_PER_S,
            end_s=(last_ns - records[0].stamp_ns) / NS_PER_S,
            frames=len(frames),
            constraints=int(((constrained_ns >= first_ns) & (constrained_ns <= last_ns)).sum()),
            sigma_m=float(np.median(known)) if state != "not localised" and len(known) else None,
        )
