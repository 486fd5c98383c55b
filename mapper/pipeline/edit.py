"""Edits by hand of a finished run, of its loops or its maps: solved and fused again, but not tracked."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mapper.config.build import BuildConfig
from mapper.core.doubts import Doubt
from mapper.core.errors import ConfigError, LoopError
from mapper.core.frames import RgbdFrame, Sensor
from mapper.core.geometry import Transform, inverse
from mapper.graph.components import by_odometry, components
from mapper.graph.model import PoseGraph, PoseSigmas
from mapper.loops.base import Proposal, Verification, Verifier, closure_of
from mapper.loops.closure import LoopClosure, accepted_loops
from mapper.loops.factory import build_verifier, keyframe_loops
from mapper.loops.image_verification import verify_aligned
from mapper.loops.scan_verification import ScanVerifier
from mapper.mapping.config import EditKind, Region
from mapper.pipeline.fuse import fuse_again
from mapper.pipeline.lidar_adjustment import adjust_stored
from mapper.pipeline.reobserve import reobserve
from mapper.pipeline.solve import solve
from mapper.run.edits_file import EditsFile, edits_text, with_region, without_last
from mapper.run.folder import Run
from mapper.run.manifest import Solve
from mapper.run.stored_tracking import StoredTracking, load_tracking
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import Log

Pair = tuple[int, int]
"""Two nodes."""
_BY_EYE_VOXELS, _BY_EYE_RAD = 2.0, 0.03
"""Error of an alignment by eye, along and about each axis: people see clouds as sharp as the octree."""


@dataclass(frozen=True, slots=True, eq=False)
class _Alignment:
    """Alignment of two frames by hand, if there was one.

    Attributes:
        T_i_j: (4, 4) pose of the second frame in the first.
        by_eye: It is the measurement, and not where that begins.
    """

    T_i_j: Transform | None = None
    by_eye: bool = False

    @property
    def inverse(self) -> "_Alignment":
        return replace(self, T_i_j=None if self.T_i_j is None else inverse(self.T_i_j))


def edit_loops(
    source: Log,
    run: Run,
    *,
    add: Sequence[Pair] = (),
    remove: Sequence[Pair] = (),
    progress: Progress = SILENT,
) -> Run:
    """Add and remove loops, solve once, fuse what has moved; the run stays as it is unless all of it works.

    An added pair skips the proposal, the gate and the consistency check, but not the measurement: the
    two frames are compared as every candidate is. The solve starts from odometry alone, so the outcome does
    not depend on the order of edits.

    Args:
        source: The log that the run was built from.
        run: A finished run.
        add: Pairs of nodes that show one place.
        remove: Pairs of nodes of loops that are wrong.
        progress: Receives stages, counts and notes.

    Raises:
        ConfigError: The run's configuration does not solve its graph.
        LoopError: A node is unknown, a loop is there already or is not, two frames do not show one place, or
            the solver rejects a loop that was added.
    """
    changed, report = _solve_edited(source, run, dict.fromkeys(add, _Alignment()), remove, progress=progress)
    return fuse_again(source, run, changed, solve=report, progress=progress)


def apply_edits(source: Log, run: Run, edits: EditsFile, *, progress: Progress = SILENT) -> Run:
    """Make all edits of an edits file: its loops in one solve, then its regions; then fuse once.

    Args:
        source: The log that the run was built from.
        run: A finished run, which stays as it is unless all of it works.
        edits: The edits; regions are added to those of the run.
        progress: Receives stages, counts and notes.

    Raises:
        MapperError: There are none, or as :func:`edit_loops` and :func:`add_region`.
    """
    if edits == EditsFile():
        raise ConfigError("edits: none; want accept, reject, drop, erase, keep or keepout")
    text = edits_text(run.path)
    for kind, region in edits.regions:
        text = with_region(text, run.path, kind, region)
    changed, report = None, None
    if edits.accept or edits.reject or edits.drop:
        aligned = {loop.nodes: _Alignment(loop.aligned, by_eye=loop.by_eye) for loop in edits.accept}
        if len(aligned) < len(edits.accept):
            raise ConfigError("edits: accept: the same nodes twice")
        rejected = [loop.nodes for loop in edits.reject]
        changed, report = _solve_edited(source, run, aligned, rejected, edits.drop, progress=progress)
    regions = text if len(edits) else None
    return fuse_again(source, run, changed, solve=report, edits=regions, progress=progress)


def _solve_edited(
    source: Log,
    run: Run,
    add: Mapping[Pair, _Alignment],
    remove: Sequence[Pair],
    drop: Sequence[int] = (),
    *,
    progress: Progress,
) -> tuple[StoredTracking, Solve]:
    """Solve with loops added, by how they were aligned by hand, and removed, and with nodes dropped."""
    if run.config.graph.solve == "none":
        raise ConfigError(f"{run.path}: built with graph.solve=none, so loops change nothing; build it again")
    tracked = _drop_nodes(load_tracking(run), drop)
    graph, loops = tracked.graph, list(tracked.loops)
    for pair in remove:
        place = _held(loops, pair)
        if place is None:
            raise LoopError(f"loop {_text(pair)}: no loop of {run.path} to remove; mapper loops lists them")
        loops[place] = loops[place].rejected("hand", "removed")
    aligned = {}
    for pair, alignment in add.items():
        i, j = _in_time_order(graph, pair)
        if _held(loops, pair) is not None or (i, j) in aligned:
            raise LoopError(f"loop {_text((i, j))}: there already")
        aligned[i, j] = alignment if (i, j) == pair else alignment.inverse
    pairs = list(aligned)
    if pairs:
        found = _measured(source, tracked, aligned, run.config)
        loops = [loop for loop in loops if (loop.i, loop.j) not in pairs] + found
    held = (loop.factor for loop in accepted_loops(loops))
    edited = graph.with_poses(by_odometry(graph)).with_loops(held)
    solved = solve(edited, loops, run.config.graph)
    for loop in solved.loops[len(loops) - len(pairs) :]:
        _refuse_rejected(loop)
    if len(components(solved.graph)) > len(components(graph)):
        raise LoopError(f"{run.path}: without these loops the graph falls apart; nothing removed")
    tracked = tracked.solved(solved.graph, solved.loops)
    rotating = run.manifest.with_body_rates(source)
    return adjust_stored(rotating, tracked, solved.report, run.config, progress=progress)


def _drop_nodes(tracked: StoredTracking, nodes: Sequence[int]) -> StoredTracking:
    """Return the tracking with the frames of some nodes doubtful, so that no map has them."""
    for node in nodes:
        if node not in tracked.graph.T_world_node:
            raise LoopError(
                f"node {node}: cannot be dropped; the graph's nodes are {_range_of(tracked.graph)}"
            )
    doubt = Doubt("disagreement", "dropped by hand")
    records = [
        replace(record, outcome="doubtful", doubts=(*record.doubts, doubt))
        if record.node in nodes and record.outcome in ("tracked", "doubtful")
        else record
        for record in tracked.records
    ]
    loops = [
        loop.rejected("hand", "its keyframe was dropped")
        if loop.verdict == "accepted" and (loop.i in nodes or loop.j in nodes)
        else loop
        for loop in tracked.loops
    ]
    return replace(tracked, records=records, loops=loops)


def _range_of(graph: PoseGraph) -> str:
    return f"0 … {max(graph.T_world_node)}"


def _held(loops: Sequence[LoopClosure], pair: Pair) -> int | None:
    """Return the index of the accepted loop between two nodes, in either order."""
    for place, loop in enumerate(loops):
        if loop.verdict == "accepted" and {loop.i, loop.j} == set(pair):
            return place
    return None


def _in_time_order(graph: PoseGraph, pair: Pair) -> Pair:
    for node in pair:
        if node not in graph.T_world_node:
            raise LoopError(f"loop {_text(pair)}: no node {node}; the graph's nodes are {_range_of(graph)}")
    if pair[0] == pair[1]:
        raise LoopError(f"loop {_text(pair)}: a node cannot be connected to itself")
    i, j = sorted(pair, key=graph.stamps_ns.__getitem__)
    return i, j


def _measured(
    source: Log, tracked: StoredTracking, aligned: Mapping[Pair, _Alignment], config: BuildConfig
) -> list[LoopClosure]:
    verifier, graph = _verifier(config, source.sensor), tracked.graph
    stamps_ns = {graph.stamps_ns[node] for pair in aligned for node in pair}
    views = reobserve(source, tracked.trajectory, stamps_ns, config)
    places = {stamp_ns: verifier.describe(seen) for stamp_ns, seen in views.items()}
    loops = []
    for (i, j), alignment in aligned.items():
        place_i, place_j = (places[graph.stamps_ns[node]] for node in (i, j))
        if alignment.by_eye:
            sigma_m = _BY_EYE_VOXELS * config.octree.resolution_m
            information = PoseSigmas(rotation_rad=_BY_EYE_RAD, translation_m=sigma_m).information
            found = Verification(0, "", T_i_j=alignment.T_i_j, information=information)
        else:
            found = _verify(source, verifier, place_i, place_j, alignment.T_i_j)
        loops.append(closure_of(Proposal(i, "hand"), j, place_i, place_j, found))
        _refuse_rejected(loops[-1])
    return loops


def _verify(source: Log, verifier: Verifier[Any], i: Any, j: Any, T_i_j: Transform | None) -> Verification:
    """Return the result of comparing two places, which a person may have aligned."""
    if T_i_j is not None and isinstance(verifier, ScanVerifier):
        return verifier.verify_near(i, j, T_i_j)
    found = verifier.verify(i, j)
    if T_i_j is None or not found.reason:
        return found
    frames = (source.entry_of(place.stamp_ns).load() for place in (i, j))
    frame_i, frame_j = (frame for frame in frames if isinstance(frame, RgbdFrame))
    return verify_aligned(frame_i, frame_j, T_i_j)


def _verifier(config: BuildConfig, sensor: Sensor) -> Verifier[Any]:
    loops = keyframe_loops(config.loops, sensor) if config.loops.kind == "none" else config.loops
    return build_verifier(loops.verification)


def _refuse_rejected(loop: LoopClosure) -> None:
    if loop.verdict == "rejected":
        raise LoopError(f"loop {_text((loop.i, loop.j))}: not added; {loop.reason}")


def _text(pair: Pair) -> str:
    return f"{pair[0]} → {pair[1]}"


def add_region(source: Log, run: Run, kind: EditKind, region: Region, *, progress: Progress = SILENT) -> Run:
    """Add a region to a run's ``edits.toml`` and make its maps again; the run stays as it is if that fails.

    Args:
        source: The log that the run was built from.
        run: A finished run.
        kind: Kind of the edit.
        region: The region.
        progress: Receives stages, counts and notes.

    Raises:
        ConfigError: The run's edits are not valid.
        DataError: They would leave nothing of the map.
        RunError: The log is not the one that the run was built from.
    """
    text = with_region(edits_text(run.path), run.path, kind, region)
    return fuse_again(source, run, edits=text, progress=progress)


def undo_region(source: Log, run: Run, *, progress: Progress = SILENT) -> Run:
    """Take the last region of a run's ``edits.toml`` back and make its maps again; see ``add_region``.

    Raises:
        ConfigError: There is none, or the run's edits are not valid.
        RunError: The log is not the one that the run was built from.
    """
    return fuse_again(source, run, edits=without_last(edits_text(run.path), run.path), progress=progress)
