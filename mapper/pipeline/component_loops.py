"""Loops between the parts of a broken path: images of one place from very different distances."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, product

import numpy as np

from mapper.config.build import BuildConfig
from mapper.core.frames import Frame, RgbdFrame
from mapper.core.geometry import Array, Transform, adjoint, inverse, mean_pose
from mapper.core.timebase import NS_PER_S
from mapper.features.config import SiftConfig
from mapper.features.frame_view import ImageView
from mapper.graph.components import components
from mapper.graph.model import PoseGraph
from mapper.loops.base import Verification
from mapper.loops.closure import (
    LEAST_AGREEING,
    Discrepancy,
    LoopClosure,
    accepted_loops,
    exceeds,
    pose_difference,
)
from mapper.loops.config import SLACK_RAD, GateConfig, PlaceLoopsConfig
from mapper.loops.image_verification import verify_wide
from mapper.odometry.base import FrameResult
from mapper.odometry.config import IsvdOdometryConfig
from mapper.pipeline.reobserve import reobserve
from mapper.pipeline.tracking_result import TrackingResult
from mapper.runtime.progress import Progress
from mapper.sources.base import Log

_VIEWS = 80
"""Keyframes of all parts that are compared: some seconds of work."""
_ODOMETRY = IsvdOdometryConfig(
    detector=SiftConfig(max_features=800, threshold=0.01, min_threshold=0.01), max_depth_m=12.0
)
"""Whose views are compared: with more features than usual, as little of the farther view is shared."""
_AROUND, _AROUND_NS = 3, NS_PER_S
"""Frames before and after one that shows a known place, within this time: they measure it as well."""


@dataclass(frozen=True, slots=True, eq=False)
class _Link:
    """Two frames of different parts that show one place.

    Attributes:
        i: The frame of the smaller node.
        j: The other.
        T_i_j: (4, 4) measured pose of j's node in i's.
        information: (6, 6) of the tangent of j's node (rotation, translation).
        found: Result of comparing the frames.
    """

    i: FrameResult
    j: FrameResult
    T_i_j: Transform
    information: Array
    found: Verification

    @property
    def nodes(self) -> tuple[int, int]:
        """Nodes that the frames are placed by."""
        assert self.i.node is not None
        assert self.j.node is not None
        return self.i.node, self.j.node


def joined(
    source: Log, tracking: TrackingResult, config: BuildConfig, *, progress: Progress
) -> TrackingResult:
    """Return the result with loops between parts of the path that nothing connected, where any are found.

    A place that one part shows from near and another from far has hardly an ORB feature in common. Keyframes
    of all parts are compared by SIFT; a place counts if pairs of frames around agree on it.

    Args:
        source: The log.
        tracking: Result of its first pass.
        config: All settings; nothing is searched unless loops between images are.
        progress: Receives the stage and notes.
    """
    parts = components(tracking.graph)
    if len(parts) < 2 or source.sensor != "rgbd" or not isinstance(config.loops, PlaceLoopsConfig):
        return tracking
    loops = _Search(source, tracking, config, config.loops.gate, progress).loops(parts)
    accepted = accepted_loops(loops)
    for loop in accepted:
        progress.note(
            f"nodes {loop.i} and {loop.j}, of two parts of the path, show one place: {loop.inliers} features "
            "and the depth images agree"
        )
    graph = tracking.graph.with_factors([*tracking.graph.factors, *(loop.factor for loop in accepted)])
    return replace(tracking, graph=graph, loops=(*tracking.loops, *loops))


class _Search:
    def __init__(
        self,
        source: Log,
        tracking: TrackingResult,
        config: BuildConfig,
        gate: GateConfig,
        progress: Progress,
    ) -> None:
        self._source, self._graph, self._gate = source, tracking.graph, gate
        self._config = config.model_copy(update={"odometry": _ODOMETRY})
        self._progress = progress
        self._trajectory = tracking.trajectory()
        self._tracks = tracking.tracked
        self._views: dict[int, ImageView] = {}
        self._frame_of = lru_cache(16)(lambda stamp_ns: _rgbd(source.entry_of(stamp_ns).load()))

    def loops(self, parts: Sequence[Sequence[int]]) -> list[LoopClosure]:
        """Return the loops between parts, given as nodes, at most one for any two, with their verdicts."""
        keyframes = self._keyframes(parts)
        self._observe(frame for part in keyframes for frame in part)
        loops = []
        for first, second in combinations(keyframes, 2):
            hits = self._links(product(first, second))
            around = {
                (i.stamp_ns, j.stamp_ns): (i, j)
                for link in hits
                for i, j in product(self._around(link.i), self._around(link.j))
            }
            links = self._links(around.values())
            if (loop := _agreed(links, self._graph, self._gate)) is not None:
                loops.append(loop)
        return loops

    def _keyframes(self, parts: Sequence[Sequence[int]]) -> list[list[FrameResult]]:
        frame_of = {track.node: track for track in self._tracks if track.is_keyframe}
        of_parts = [[frame_of[node] for node in nodes if node in frame_of] for nodes in parts]
        share = min(1.0, _VIEWS / max(sum(map(len, of_parts)), 1))
        return [_spread(frames, round(share * len(frames))) for frames in of_parts]

    def _around(self, frame: FrameResult) -> list[FrameResult]:
        index = self._tracks.index(frame)
        nearby = self._tracks[max(index - _AROUND, 0) : index + _AROUND + 1]
        return [other for other in nearby if abs(other.stamp_ns - frame.stamp_ns) <= _AROUND_NS]

    def _observe(self, frames: Iterable[FrameResult]) -> None:
        """Detect the features of frames that are not observed yet."""
        stamps_ns = {frame.stamp_ns for frame in frames} - self._views.keys()
        if stamps_ns:
            views = reobserve(
                self._source, self._trajectory, stamps_ns, self._config, progress=self._progress
            )
            self._views |= {stamp_ns: view for stamp_ns, view in views.items() if isinstance(view, ImageView)}

    def _links(self, pairs: Iterable[tuple[FrameResult, FrameResult]]) -> list[_Link]:
        """Return which of the pairs of frames show one place."""
        ordered = [(i, j) if (i.node or 0) < (j.node or 0) else (j, i) for i, j in pairs]
        self._observe(frame for pair in ordered for frame in pair)
        links = (self._link(i, j) for i, j in ordered)
        return [link for link in links if link is not None]

    def _link(self, i: FrameResult, j: FrameResult) -> _Link | None:
        """Compare two frames; the points are those of the nearer view, whose depths are better."""
        seen_i, seen_j = self._views[i.stamp_ns], self._views[j.stamp_ns]
        is_near = _distance_m(seen_i) <= _distance_m(seen_j)
        found = verify_wide(*(seen_i, seen_j) if is_near else (seen_j, seen_i), self._frame_of)
        T_i_j, information = found.T_i_j, found.information
        if T_i_j is None or information is None:
            return None
        if not is_near:
            T_i_j = inverse(T_i_j)
            information = adjoint(T_i_j).T @ information @ adjoint(T_i_j)
        T_nodes = i.T_node_body @ T_i_j @ inverse(j.T_node_body)
        return _Link(i, j, T_nodes, _carried(information, inverse(j.T_node_body)), found)


def _agreed(links: Sequence[_Link], graph: PoseGraph, gate: GateConfig) -> LoopClosure | None:
    """Return the mean of the links that agree with the best one; None if they are few, or many do not.

    Frames around one place have errors in common, so that the mean has the information of one link.
    """
    if not links:
        return None
    best = max(links, key=lambda link: link.found.inliers)
    carried = [_between_nodes_of(best, link, graph) for link in links]
    reach_m = float(np.linalg.norm(best.T_i_j[:3, 3]))
    limit = Discrepancy(gate.slack_m + gate.drift_ratio * reach_m, SLACK_RAD)
    agreeing = [
        (T_i_j, information)
        for T_i_j, information in carried
        if not exceeds(pose_difference(T_i_j, best.T_i_j), limit)
    ]
    if len(agreeing) < LEAST_AGREEING or 2 * len(agreeing) <= len(links):
        return None
    poses, informations = zip(*agreeing, strict=True)
    (i, j), found = best.nodes, best.found
    return LoopClosure(
        i=i,
        j=j,
        stamp_i_ns=graph.stamps_ns[i],
        stamp_j_ns=graph.stamps_ns[j],
        proposed_by="places",
        verdict="accepted",
        matches=found.matches,
        inliers=found.inliers,
        residual_px=found.residual_px,
        T_i_j=mean_pose(best.T_i_j, poses, informations),
        information=np.sum(informations, axis=0) / len(agreeing),
    )


def _between_nodes_of(best: _Link, link: _Link, graph: PoseGraph) -> tuple[Transform, Array]:
    """Return what a link measures between another one's nodes, and its information."""
    (i, j), (at_i, at_j) = best.nodes, link.nodes
    T_world = graph.T_world_node
    T_j = inverse(T_world[at_j]) @ T_world[j]
    return inverse(T_world[i]) @ T_world[at_i] @ link.T_i_j @ T_j, _carried(link.information, T_j)


def _carried(information: Array, T_j_k: Transform) -> Array:
    to_j = adjoint(T_j_k)
    return to_j.T @ information @ to_j


def _spread(frames: list[FrameResult], count: int) -> list[FrameResult]:
    """Return this number of the frames, at least two, evenly spread from the first to the last."""
    indices = np.linspace(0, len(frames) - 1, max(min(count, len(frames)), min(2, len(frames))))
    return [frames[index] for index in np.unique(indices.round().astype(int)).tolist()]


def _distance_m(view: ImageView) -> float:
    """Return the median depth of a view's features; infinite without any."""
    z = view.points_camera[:, 2]
    z = z[~np.isnan(z)]
    return float(np.median(z)) if len(z) else np.inf


def _rgbd(frame: Frame) -> RgbdFrame:
    assert isinstance(frame, RgbdFrame)  # of an RGB-D log
    return frame
