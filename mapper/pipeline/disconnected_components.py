"""Parts of a path that are left out of the graph: disconnected ones, and doubtful keyframes at its ends."""

from collections import Counter, defaultdict
from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np

from mapper.core.geometry import adjoint, inverse
from mapper.graph.components import components
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.loops.closure import LoopClosure
from mapper.odometry.base import Diagnostics, FrameResult
from mapper.pipeline.tracking_result import TrackingResult
from mapper.run.frame_records import DISCONNECTED
from mapper.runtime.progress import Progress


def largest_component(tracking: TrackingResult, *, progress: Progress) -> TrackingResult:
    """Return the component with most tracked frames, and note how many frames are left out.

    After a loss the odometry may begin a new component. Until a loop connects the two, their relative pose
    is unknown, and a map of both would be a guess: the frames left out count as lost.
    """
    frames = Counter(track.node for track in tracking.tracked)
    parts = components(tracking.graph)
    largest = max(parts, key=lambda nodes: sum(frames[node] for node in nodes), default=[])
    return component_of(tracking, largest[0], progress=progress) if largest else tracking


def component_of(tracking: TrackingResult, node: int, *, progress: Progress) -> TrackingResult:
    """Return the component that holds a node, and note how many frames are left out."""
    parts = components(tracking.graph)
    if len(parts) <= 1:
        return tracking
    frames = Counter(track.node for track in tracking.placed)
    kept = frozenset(next(nodes for nodes in parts if node in nodes))
    left_out = sum(frames[node] for nodes in parts for node in nodes if node not in kept)
    progress.note(
        f"{left_out} of {len(tracking.placed)} frames lie in {len(parts) - 1} parts of the path that nothing "
        "connects to the rest; they are left out"
    )
    return replace(
        tracking,
        tracks=tuple(
            track if track.node is None or track.node in kept else disconnected(track)
            for track in tracking.tracks
        ),
        graph=tracking.graph.part(kept),
        loops=tuple(_refused_unless(loop, kept) for loop in tracking.loops),
    )


def disconnected(track: FrameResult) -> FrameResult:
    """Return the result of a frame without the pose, which nothing connects to the rest."""
    nothing = Diagnostics(
        track.diagnostics.features, 0, 0, 0.0, track.diagnostics.residual_unit, DISCONNECTED
    )
    return replace(
        track,
        node=None,
        T_node_body=np.eye(4),
        is_keyframe=False,
        diagnostics=nothing,
        doubts=(),
        covariance=None,
    )


def _refused_unless(loop: LoopClosure, kept: Set[int]) -> LoopClosure:
    if loop.verdict == "rejected" or loop.i in kept:
        return loop
    return loop.rejected("disconnected", "in a part of the path that is left out")


def without_doubtful_ends(
    tracks: Sequence[FrameResult], graph: PoseGraph
) -> tuple[list[FrameResult], PoseGraph]:
    """Return the results and the graph without doubtful keyframes at the end of one factor.

    A doubtful frame is placed by its own pose and by the motion of the tracked frames around it, a node by
    its factors alone. Where one factor holds a doubtful keyframe, and no frame without a doubt is placed
    relative to it, it need not be a node: it and its frames become frames of the keyframe before it.

    Args:
        tracks: Results of a log's frames, in time order.
        graph: Graph with their nodes and all factors.
    """
    factors_of: dict[int, list[BetweenFactor]] = defaultdict(list)
    for factor in graph.factors:
        factors_of[factor.i].append(factor)
        factors_of[factor.j].append(factor)
    frames_of: dict[int, list[int]] = defaultdict(list)
    for index, track in enumerate(tracks):
        if track.node is not None:
            frames_of[track.node].append(index)
    changed, removed = list(tracks), set[int]()
    doubtful = [track.node for track in tracks if track.is_keyframe and track.doubts]
    for node in reversed([node for node in doubtful if node is not None]):
        factors = [factor for factor in factors_of[node] if removed.isdisjoint((factor.i, factor.j))]
        frames = frames_of[node]
        if len(factors) == 1 and factors[0].j == node and all(changed[k].doubts for k in frames):
            for k in frames:
                changed[k] = _relative_to_earlier(changed[k], factors[0])
            frames_of[factors[0].i] += frames
            removed.add(node)
    if not removed:
        return changed, graph
    return changed, graph.part(graph.T_world_node.keys() - removed)


def _relative_to_earlier(track: FrameResult, factor: BetweenFactor) -> FrameResult:
    to_body = adjoint(inverse(track.T_node_body))
    covariance = to_body @ np.linalg.inv(factor.information) @ to_body.T
    if not track.is_keyframe and track.covariance is not None:
        covariance = covariance + track.covariance
    return replace(
        track,
        node=factor.i,
        T_node_body=factor.T_i_j @ track.T_node_body,
        is_keyframe=False,
        factors=(),
        links=(),
        covariance=0.5 * (covariance + covariance.T),
    )
