"""Jumps that the odometry missed: the path is cut where constraints to a map show them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np

from mapper.core.geometry import Transform, inverse
from mapper.core.timebase import NS_PER_S
from mapper.graph.components import components
from mapper.loops.closure import discrepancy, exceeds
from mapper.loops.config import GateConfig
from mapper.loops.odometry_chain import NodePath, allowed
from mapper.pipeline.components import disconnected
from mapper.pipeline.tracking_result import TrackingResult
from mapper.runtime.progress import Progress

_WINDOW, _LEAST = 5, 3
"""Constraints on either side of a jump that are compared, and how many there must be."""
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
        step = discrepancy(np.eye(4), T_odometry[before], T_odometry[node])
        path_m, turned_rad = path_m + step.translation_m, turned_rad + step.rotation_rad
        if node in T_map_node:
            path = NodePath(path_m, turned_rad)
            found.append(_Constrained(node, T_map_node[node], T_odometry[node], path))
    return found


def _jumps(constrained: Sequence[_Constrained], gate: GateConfig) -> list[tuple[int, int]]:
    """Return the last node before every jump and the first after it."""
    best, least = None, _MAX_ACROSS
    for k in range(_LEAST, len(constrained) - _LEAST + 1):
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
    return not exceeds(discrepancy(np.eye(4), T_map_b, b.T_map_node), allowed(gate, path))


def _cut(tracking: TrackingResult, last: int, first: int, map_node: int) -> TrackingResult:
    """Return the result without what connects two nodes along the path."""
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
