"""Parts of a path that the odometry left untied: wheels and loops tie them; what nothing ties is left out."""

from collections import Counter
from collections.abc import Set
from dataclasses import replace

import numpy as np

from mapper.geometry import Transform, inverse
from mapper.graph.model import PoseGraph
from mapper.graph.optimize import components
from mapper.loops.closure import LoopClosure
from mapper.odometry.base import Diagnostics, Track
from mapper.progress import Progress
from mapper.tracking import Tracking

UNTIED = "untied"
"""``Diagnostics.method`` of a frame that was placed, but in a part of the path that is left out."""


def largest_part(tracking: Tracking, *, progress: Progress) -> Tracking:
    """Return what was tracked without the parts that nothing ties to the one with most frames, and say so.

    After a loss the odometry may begin anew where nothing is known. Until a loop joins the two parts, nobody
    knows how they lie to each other, and a map of both would be a guess: the frames left out count as lost.
    """
    frames = Counter(track.node for track in tracking.placed)
    parts = components(tracking.graph)
    largest = max(parts, key=lambda nodes: sum(frames[node] for node in nodes), default=[])
    return part_of(tracking, largest[0], progress=progress) if largest else tracking


def part_of(tracking: Tracking, node: int, *, progress: Progress) -> Tracking:
    """Return what was tracked without the parts that nothing ties to a node's own, and say so."""
    parts = components(tracking.graph)
    if len(parts) <= 1:
        return tracking
    frames = Counter(track.node for track in tracking.placed)
    kept = frozenset(next(nodes for nodes in parts if node in nodes))
    left_out = sum(frames[node] for nodes in parts for node in nodes if node not in kept)
    progress.note(
        f"{left_out} of {len(tracking.placed)} frames lie in {len(parts) - 1} parts of the path that nothing "
        "ties to the rest; they are left out"
    )
    graph = tracking.graph
    return replace(
        tracking,
        tracks=tuple(_lost_unless(track, kept) for track in tracking.tracks),
        graph=PoseGraph(
            {node: T for node, T in graph.T_world_node.items() if node in kept},
            {node: stamp_ns for node, stamp_ns in graph.stamps_ns.items() if node in kept},
            [factor for factor in graph.factors if factor.i in kept],
        ),
        loops=tuple(_refused_unless(loop, kept) for loop in tracking.loops),
    )


def _lost_unless(track: Track, kept: Set[int]) -> Track:
    if track.node is None or track.node in kept:
        return track
    nothing = Diagnostics(track.diagnostics.features, 0, 0, 0.0, track.diagnostics.residual_unit, UNTIED)
    return replace(track, node=None, T_node_body=np.eye(4), is_keyframe=False, diagnostics=nothing)


def _refused_unless(loop: LoopClosure, kept: Set[int]) -> LoopClosure:
    if loop.verdict == "rejected" or loop.i in kept:
        return loop
    return replace(loop, verdict="rejected", reason="untied: in a part of the path that is left out")


def laid_together(graph: PoseGraph) -> PoseGraph:
    """Return the graph with every part that the odometry left untied moved to where the first tie says.

    A part begun after a loss stands where the camera was last seen, which may be rooms away from where it
    was: no place for a solver to start from.
    """
    known = PoseGraph(
        graph.T_world_node, graph.stamps_ns, [f for f in graph.factors if f.origin == "odometry"]
    )
    waiting = components(known)
    if len(waiting) <= 1:
        return graph
    T_world_node = {node: graph.T_world_node[node] for node in waiting.pop(0)}
    while waiting:
        ties = [(part, _tie(graph, set(part), T_world_node)) for part in waiting]
        part, T_new_old = next((p, T) for p, T in [*ties, (waiting[0], np.eye(4))] if T is not None)
        T_world_node |= {node: T_new_old @ graph.T_world_node[node] for node in part}
        waiting.remove(part)
    in_order = {node: T_world_node[node] for node in graph.T_world_node}
    return PoseGraph(in_order, graph.stamps_ns, graph.factors)


def _tie(graph: PoseGraph, part: Set[int], T_world_laid: dict[int, Transform]) -> Transform | None:
    """Return the motion that puts a part where the first factor from what is laid wants it."""
    for factor in graph.factors:
        if factor.i in T_world_laid and factor.j in part:
            wanted, node = T_world_laid[factor.i] @ factor.T_i_j, factor.j
        elif factor.j in T_world_laid and factor.i in part:
            wanted, node = T_world_laid[factor.j] @ inverse(factor.T_i_j), factor.i
        else:
            continue
        T_new_old: Transform = wanted @ inverse(graph.T_world_node[node])
        return T_new_old
    return None
