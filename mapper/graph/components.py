"""Connected components of a pose graph, and their alignment by the factors between them."""

from collections.abc import Set

import numpy as np

from mapper.core.geometry import Transform, inverse
from mapper.graph.model import PoseGraph


def components(graph: PoseGraph) -> list[list[int]]:
    """Return the nodes of every connected component; the graph's order holds between and within them."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components  # takes half a second

    index_of = {node: index for index, node in enumerate(graph.T_world_node)}
    i = [index_of[factor.i] for factor in graph.factors]
    j = [index_of[factor.j] for factor in graph.factors]
    adjacency = coo_array((np.ones(len(i), np.int8), (i, j)), shape=(len(index_of), len(index_of)))
    _, labels = connected_components(adjacency, directed=False)
    members: dict[int, list[int]] = {}
    for node, label in zip(index_of, labels.tolist(), strict=True):
        members.setdefault(label, []).append(node)
    return list(members.values())


def component_numbers(graph: PoseGraph) -> dict[int, int]:
    """Return the number of each node's component, in the order of ``components``."""
    return {node: number for number, nodes in enumerate(components(graph)) for node in nodes}


def components_with_factors(graph: PoseGraph) -> list[tuple[list[int], list[int]]]:
    """Return (nodes, indices of their factors) of every component that has any factor."""
    parts = components(graph)
    component_of = {node: part for part, nodes in enumerate(parts) for node in nodes}
    factors: list[list[int]] = [[] for _ in parts]
    for k, factor in enumerate(graph.factors):
        factors[component_of[factor.i]].append(k)
    return [(nodes, indices) for nodes, indices in zip(parts, factors, strict=True) if indices]


def align_components(graph: PoseGraph) -> PoseGraph:
    """Return the graph with every component of the odometry moved to where its first factor puts it.

    A component begun after a loss starts at the last pose before it, which may be rooms away from the true
    one: too far for a solver to start from.
    """
    remaining = components(graph.with_factors(f for f in graph.factors if f.origin == "odometry"))
    if len(remaining) <= 1:
        return graph
    T_world_node = {node: graph.T_world_node[node] for node in remaining.pop(0)}
    while remaining:
        motions = [(nodes, _alignment(graph, set(nodes), T_world_node)) for nodes in remaining]
        nodes, T_new_old = next((n, T) for n, T in [*motions, (remaining[0], np.eye(4))] if T is not None)
        T_world_node |= {node: T_new_old @ graph.T_world_node[node] for node in nodes}
        remaining.remove(nodes)
    return graph.with_poses({node: T_world_node[node] for node in graph.T_world_node})


def _alignment(
    graph: PoseGraph, component: Set[int], T_world_aligned: dict[int, Transform]
) -> Transform | None:
    """Return the motion that aligns a component with the first factor from those already aligned."""
    for factor in graph.factors:
        if factor.i in T_world_aligned and factor.j in component:
            T_world_new, node = T_world_aligned[factor.i] @ factor.T_i_j, factor.j
        elif factor.j in T_world_aligned and factor.i in component:
            T_world_new, node = T_world_aligned[factor.j] @ inverse(factor.T_i_j), factor.i
        else:
            continue
        return T_world_new @ inverse(graph.T_world_node[node])
    return None


def by_odometry(graph: PoseGraph) -> dict[int, Transform]:
    """Return T_world_node, each chained by the first factor to an earlier node that is no loop.

    A node without such a factor, as the first one, keeps its pose.
    """
    order = {node: place for place, node in enumerate(graph.T_world_node)}
    T_earlier_node: dict[int, tuple[int, Transform]] = {}
    for factor in graph.factors:
        if factor.origin == "loop":
            continue
        if order[factor.i] < order[factor.j]:
            T_earlier_node.setdefault(factor.j, (factor.i, factor.T_i_j))
        else:
            T_earlier_node.setdefault(factor.i, (factor.j, inverse(factor.T_i_j)))
    T_world_node: dict[int, Transform] = {}
    for node, T in graph.T_world_node.items():
        if node in T_earlier_node:
            earlier, T_earlier = T_earlier_node[node]
            T = T_world_node[earlier] @ T_earlier
        T_world_node[node] = T
    return T_world_node
