"""How far the path is from one node to another, and so how far the odometry may have drifted on it."""

import heapq
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import rotation_log
from mapper.graph.model import BetweenFactor
from mapper.loops.closure import Discrepancy
from mapper.loops.config import GateConfig


@dataclass(frozen=True, slots=True)
class NodePath:
    """The shortest way between two nodes, over links and loops."""

    path_m: float
    turned_rad: float


class OdometryChain:
    """Which nodes are tied to which, and how long each tie is.

    Loops are ties as well, so a place seen again is close to everything that was seen around it before:
    the uncertainty between two nodes is that of the best way between them, not of the time that has passed.
    """

    def __init__(self) -> None:
        self._ties: dict[int, list[tuple[int, float, float]]] = {}
        self._parent: dict[int, int] = {}

    def add(self, factors: Iterable[BetweenFactor]) -> None:
        """Add ties between nodes."""
        for factor in factors:
            path_m = float(np.linalg.norm(factor.T_i_j[:3, 3]))
            turned_rad = float(np.linalg.norm(rotation_log(factor.T_i_j[:3, :3])))
            for a, b in ((factor.i, factor.j), (factor.j, factor.i)):
                self._ties.setdefault(a, []).append((b, path_m, turned_rad))
            self._parent[self.component_of(factor.j)] = self.component_of(factor.i)

    def component_of(self, node: int) -> int:
        """Return the name of a node's part: two nodes have the same while ties lead from one to the other."""
        root = node
        while (parent := self._parent.get(root, root)) != root:
            root = parent
        while node != root:
            self._parent[node], node = root, self._parent[node]
        return root

    def between(self, a: int, b: int) -> NodePath | None:
        """Return the shortest way between two nodes (Dijkstra 1959), None if nothing ties them."""
        return self._search(a, until=b, within_m=float("inf")).get(b)

    def around(self, node: int, *, within_m: float) -> dict[int, NodePath]:
        """Return the nodes no farther along the path than a limit, with the way to each."""
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
            for other, more_m, more_rad in self._ties.get(node, ()):
                if other not in reached and path_m + more_m <= within_m:
                    step = (cost + more_m + more_rad, other, path_m + more_m, turned_rad + more_rad)
                    heapq.heappush(queue, step)
        return reached


def allowed(config: GateConfig, path: NodePath) -> Discrepancy:
    """Return how far off two nodes may be after this way."""
    return Discrepancy(
        translation_m=config.slack_m + config.drift_ratio * path.path_m,
        rotation_rad=config.slack_rad
        + config.drift_rad_per_m * path.path_m
        + config.drift_rad_per_rad * path.turned_rad,
    )
