"""Paths between the nodes of a pose graph, and the drift that odometry and wheels may have on them."""

import heapq
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, adjoint, inverse, length_and_angle
from mapper.graph.model import BetweenFactor
from mapper.loops.closure import Discrepancy
from mapper.loops.config import SLACK_RAD, GateConfig

LARGEST_SIGMA_M, LARGEST_SIGMA_RAD = 1.0, 0.5
"""Largest standard deviations of an odometry's step: a motion that surfaces leave open is still predicted."""


@dataclass(frozen=True, slots=True)
class NodePath:
    """Best path between two nodes, over odometry, wheels and loops."""

    path_m: float
    turned_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """Best path from one node to another, and its uncertainty.

    Attributes:
        path: Its length.
        covariance: (6, 6) of the last node's pose in the first, in the last's tangent (rotation,
            translation), rad² and m²: those of the steps, added up to first order (Barfoot & Furgale 2014,
            eq. 55).
        by_wheels: Whether it leads over a wheel factor.
    """

    path: NodePath
    covariance: Array
    by_wheels: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Edge:
    """A factor, as a step of a path.

    Attributes:
        factor: The factor.
        covariance: (6, 6) of its j.
        path_m: Its distance.
        turned_rad: Its angle.
        cost: Cost that shortest paths minimise: distance, angle, and their standard deviations.
    """

    factor: BetweenFactor
    covariance: Array
    path_m: float
    turned_rad: float
    cost: float


class OdometryChain:
    """Odometry chain: the factors between nodes, how long each is, and how uncertain.

    Loops are factors as well, so a place seen again is close to everything that was seen around it before:
    the uncertainty between two nodes is that of the best path between them, not of the time that has passed.

    Shortest paths are searched by hand: ``around`` limits metres where the search minimises metres plus
    radians, which scipy's Dijkstra cannot, and a graph that grows with every keyframe would be copied for
    every query. At 10 000 nodes that takes 2.9 ms around a node instead of 0.02 ms, if 4.6 ms instead of 14
    ms between far ends.
    """

    def __init__(self) -> None:
        self._edges: dict[int, list[tuple[int, _Edge]]] = {}
        self._component = np.arange(1)  # of each node: the number of one in it
        self._members: dict[int, list[int]] = {}  # of components of more than one node

    def add(self, factors: Iterable[BetweenFactor]) -> None:
        """Add factors between nodes."""
        for factor in factors:
            edge = _edge(factor)
            self._edges.setdefault(factor.i, []).append((factor.j, edge))
            self._edges.setdefault(factor.j, []).append((factor.i, edge))
            self._connect(factor.i, factor.j)

    def _connect(self, i: int, j: int) -> None:
        """Join the components of two nodes under the larger one's number."""
        self._make_room(max(i, j))
        a, b = int(self._component[i]), int(self._component[j])
        if a == b:
            return
        members_a, members_b = (self._members.pop(of, [of]) for of in (a, b))
        if len(members_a) < len(members_b):
            a, members_a, members_b = b, members_b, members_a
        self._component[members_b] = a
        members_a += members_b
        self._members[a] = members_a

    def _make_room(self, node: int) -> None:
        """Add the nodes up to this one, each as a component of its own."""
        while (size := len(self._component)) <= node:
            self._component = np.concatenate([self._component, np.arange(size, 2 * size)])

    def connected(self, node: int, others: Sequence[int]) -> NDArray[np.bool_]:
        """Return which of (N,) other nodes a path connects to a node."""
        asked = np.array([node, *others], np.intp)
        self._make_room(int(asked.max()))
        component = self._component[asked]
        connected: NDArray[np.bool_] = component[1:] == component[0]
        return connected

    def between(self, a: int, b: int) -> Drift | None:
        """Return the best path from one node to another (Dijkstra 1959), None if they are disconnected."""
        reached, steps = self._search(a, until=b, within_m=float("inf"))
        if b not in reached:
            return None
        way: list[tuple[int, _Edge]] = []
        node = b
        while node != a:
            before, edge = steps[node]
            way.append((node, edge))
            node = before
        covariance = np.zeros((6, 6))
        for node, edge in reversed(way):
            covariance = _carried(covariance, edge, node)
        return Drift(reached[b], covariance, any(edge.factor.origin == "wheel" for _, edge in way))

    def around(self, node: int, *, within_m: float) -> dict[int, NodePath]:
        """Return the nodes no farther along the path than a limit, with the path to each."""
        return self._search(node, until=None, within_m=within_m)[0]

    def _search(
        self, start: int, *, until: int | None, within_m: float
    ) -> tuple[dict[int, NodePath], dict[int, tuple[int, _Edge]]]:
        """Grow outwards by metres plus radians, which a hand-held camera collects at similar rates.

        Returns:
            The path to each node that was reached, and the last step to it: from which node, by which edge.
        """
        reached: dict[int, NodePath] = {}
        steps: dict[int, tuple[int, _Edge]] = {}
        best: dict[int, float] = {start: 0.0}
        queue = [(0.0, start, 0.0, 0.0)]
        while queue:
            cost, node, path_m, turned_rad = heapq.heappop(queue)
            if node in reached:
                continue
            reached[node] = NodePath(path_m, turned_rad)
            if node == until:
                break
            for other, edge in self._edges.get(node, ()):
                further = cost + edge.cost
                if other in reached or path_m + edge.path_m > within_m:
                    continue
                if further < best.get(other, float("inf")):
                    best[other], steps[other] = further, (node, edge)
                    step = (further, other, path_m + edge.path_m, turned_rad + edge.turned_rad)
                    heapq.heappush(queue, step)
        return reached, steps


def _edge(factor: BetweenFactor) -> _Edge:
    least = np.diag([LARGEST_SIGMA_RAD**-2.0] * 3 + [LARGEST_SIGMA_M**-2.0] * 3)
    information = factor.information + least if factor.origin == "odometry" else factor.information
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    path_m, turned_rad = length_and_angle(factor.T_i_j)
    sigma_rad, sigma_m = (float(np.trace(block)) ** 0.5 for block in (covariance[:3, :3], covariance[3:, 3:]))
    return _Edge(factor, covariance, path_m, turned_rad, path_m + turned_rad + sigma_m + sigma_rad)


def _carried(covariance: Array, edge: _Edge, end: int) -> Array:
    """Return the covariance of a path's end after one more step, in the tangent of the step's end."""
    factor = edge.factor
    if factor.j == end:
        to_end, step = adjoint(inverse(factor.T_i_j)), edge.covariance
    else:
        to_end = adjoint(factor.T_i_j)
        step = to_end @ edge.covariance @ to_end.T
    return to_end @ covariance @ to_end.T + step


def allowed(config: GateConfig, path: NodePath) -> Discrepancy:
    """Return the largest discrepancy of two nodes that odometry may have after this path."""
    return Discrepancy(
        translation_m=config.slack_m + config.drift_ratio * path.path_m,
        rotation_rad=SLACK_RAD + config.drift_rad_per_m * path.path_m + config.drift_ratio * path.turned_rad,
    )
