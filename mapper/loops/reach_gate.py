"""Reach gate: loops between parts of a path that the sensor cannot have reached in the time between them."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from mapper.core.geometry import Transform, inverse
from mapper.core.timebase import NS_PER_S
from mapper.loops.closure import LoopClosure
from mapper.odometry.base import fastest_m_s

_LEAST_S = 1.0
"""Time that is allowed at least: the ends of the parts have errors, too."""


def checked_reach(
    closure: LoopClosure,
    parts: tuple[Sequence[int], Sequence[int]],
    T_world_node: Mapping[int, Transform],
    stamps_ns: Mapping[int, int],
) -> LoopClosure:
    """Return a measured loop, rejected if it places two parts farther apart than the sensor moves meanwhile.

    Nothing else rules out a loop between two rooms with the same furniture where the path is broken.

    Args:
        closure: Loop between the parts.
        parts: Nodes of the part with the loop's i, and of that with its j; none if their times are unknown.
        T_world_node: (4, 4) pose of each node, in a frame of its own part.
        stamps_ns: Time of each node.
    """
    if closure.T_i_j is None:
        return closure
    T_parts = inverse(T_world_node[closure.i]), closure.T_i_j @ inverse(T_world_node[closure.j])
    ordered = sorted((stamps_ns[node], number, node) for number in (0, 1) for node in parts[number])
    placed = [
        (stamp, number, (T_parts[number] @ T_world_node[node])[:3, 3]) for stamp, number, node in ordered
    ]
    usual, between = [], []
    for (begin_ns, part, begin), (end_ns, other, end) in pairwise(placed):
        elapsed_s, distance_m = (end_ns - begin_ns) / NS_PER_S, float(np.linalg.norm(end - begin))
        if part == other and elapsed_s > 0.0:
            usual.append(distance_m / elapsed_s)
        elif part != other:
            between.append((distance_m / max(elapsed_s, _LEAST_S), distance_m, elapsed_s))
    fastest = fastest_m_s(float(np.median(usual)) if usual else 0.0)
    if not between or max(between)[0] <= fastest:
        return closure
    _, distance_m, elapsed_s = max(between)
    apart = f"{distance_m:.1f} m apart with {elapsed_s:.1f} s between"
    return closure.rejected("reach", f"{apart}, at most {fastest:.1f} m/s is likely")
