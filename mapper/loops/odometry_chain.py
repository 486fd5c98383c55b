"""Path lengths between the nodes of a pose graph, and the drift that odometry may have on them."""

import heapq
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mapper.core.geometry import rotation_log
from mapper.graph.model import BetweenFactor
from mapper.loops.closure import Discrepancy
from mapper.loops.config import GateConfig


@dataclass(frozen=True, slots=True)
class NodePath:
    """Shortest path between two nodes, over odometry and loops."""

    path_m: float
    turned_rad: float


class OdometryChain:
    """Odometry chain: the factors between nodes, and how long each is.

    Loops are factors as well, so a place seen again is close to everything that was seen around it before:
    the uncertainty between two nodes is that of the best path between them, not of the time that has passed.

    Shortest paths are searched by hand: ``around`` limits metres where the search minimises metres plus
    radians, which scipy's Dijkstra cannot, and a graph that grows with every keyframe would be copied for
    every query. At 10 000 nodes that takes 2.9 ms around a node instead of 0.02 ms, if 4.6 ms instead of 14
    ms between far ends.
    """

    def __init__(self) -> None:
        self._neighbours: dict[int, list[tuple[int, float, float]]] = {}
        self._ends_i: list[int] = []
        self._ends_j: list[int] = []

    def add(self, factors: Iterable[BetweenFactor]) -> None:
        """Add factors between nodes."""
        for factor in factors:
            path_m = float(np.linalg.norm(factor.T_i_j[:3, 3]))
            turned_rad = float(np.linalg.norm(rotation_log(factor.T_i_j[:3, :3])))
            for a, b in ((factor.i, factor.j), (factor.j, factor.i)):
                self._neighbours.setdefault(a, []).append((b, path_m, turned_rad))
            self._ends_i.append(factor.i)
            self._ends_j.append(factor.j)

    def connected(self, node: int, others: Sequence[int]) -> NDArray[np.bool_]:
        """Return which of (N,) other nodes a path connects to a node."""
        ends = np.array([self._ends_i, self._ends_j], np.intp)
        size = 1 + max(node, *others, int(ends.max(initial=0)))
        _, labels = connected_components(
            coo_array((np.ones(ends.shape[1], np.int8), tuple(ends)), shape=(size, size)), directed=False
        )
        connected: NDArray[np.bool_] = labels[np.array(others, np.intp)] == labels[node]
        return connected

    def between(self, a: int, b: int) -> NodePath | None:
        """Return the shortest path between two nodes (Dijkstra 1959), None if they are disconnected."""
        return self._search(a, until=b, within_m=float("inf")).get(b)

    def around(self, node: int, *, within_m: float) -> dict[int, NodePath]:
        """Return the nodes no farther along the path than a limit, with the path to each."""
        return self._search(node, until=None, within_m=within_m)

    def _search(self, start: int, *, until: int | None, within_m: float) -> dict[int, NodePath]:
        """Grow outwards by metres plus radians, which a hand-held camera collects at similar rates."""
        reached: dict[int, NodePath] = {}
        queue = [(0.0, start, 0.0, 0.0)]
        while queue:
            cost, node, path_m, turned_rad = heapq.heappop(queue)
            if node in reached:
                continue
            reached[node] = NodePath(path_m, turned_rad)
            if node == until:
                break
            for other, more_m, more_rad in self._neighbours.get(node, ()):
                if other not in reached and path_m + more_m <= within_m:
                    step = (cost + more_m + more_rad, other, path_m + more_m, turned_rad + more_rad)
                    heapq.heappush(queue, step)
        return reached


def allowed(config: GateConfig, path: NodePath) -> Discrepancy:
    """Return the largest discrepancy of two nodes that odometry may have after this path."""
    return Discrepancy(
        translation_m=config.slack_m + config.drift_ratio * path.path_m,
        rotation_rad=config.slack_rad
        + config.drift_rad_per_m * path.path_m
        + config.drift_rad_per_rad * path.turned_rad,
    )
