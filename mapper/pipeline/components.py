"""Disconnected parts of a path: without a loop or wheels between them, all but one are left out."""

from collections import Counter
from collections.abc import Set
from dataclasses import replace

import numpy as np

from mapper.graph.components import components
from mapper.loops.closure import LoopClosure
from mapper.odometry.base import Diagnostics, FrameResult
from mapper.pipeline.tracking_result import TrackingResult
from mapper.run.frame_outcomes import DISCONNECTED
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
