"""Connected components of a pose graph, and their alignment by the factors between them."""

from collections.abc import Set

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mapper.core.geometry import Transform, inverse
from mapper.graph.model import PoseGraph


def components(graph: PoseGraph) -> list[list[int]]:
    """Return the nodes of every connected component; the graph's order holds between and within them."""
    index_of = {node: index for index, node in enumerate(graph.T_world_node)}
    i = [index_of[factor.i] for factor in graph.factors]
    j = [index_of[factor.j] for factor in graph.factors]
    tied = coo_array((np.ones(len(i), np.int8), (i, j)), shape=(len(index_of), len(index_of)))
    _, labels = connected_components(tied, directed=False)
    members: dict[int, list[int]] = {}
    for node, label in zip(index_of, labels.tolist(), strict=True):
        members.setdefault(label, []).append(node)
    return list(members.values())


def align_components(graph: PoseGraph) -> PoseGraph:
    """Return the graph with every component of the odometry moved to where its first connecting factor puts it.

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
    """Return the motion that aligns a component with the first factor from those already aligned."""
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
