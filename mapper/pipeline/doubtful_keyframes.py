"""Doubtful keyframes that nothing goes on from: they become frames of the keyframe before them."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapper.core.geometry import adjoint, inverse
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.odometry.base import FrameResult


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
    """Return a frame's result relative to node i of a factor instead of node j."""
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
