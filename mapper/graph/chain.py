"""Where odometry alone puts the nodes of a graph that has been solved since."""

from mapper.core.geometry import Transform, inverse
from mapper.graph.model import PoseGraph


def by_odometry(graph: PoseGraph) -> dict[int, Transform]:
    """Return T_world_node, each hung on the first factor that ties it to an earlier one and is no loop.

    A node without such a factor stays where it is, and what hangs on it goes with it: so does the first node.
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
