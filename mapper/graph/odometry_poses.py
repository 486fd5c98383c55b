"""Node poses by odometry alone, for a graph that has been solved since."""

from mapper.core.geometry import Transform, inverse
from mapper.graph.model import PoseGraph


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
