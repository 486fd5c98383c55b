"""Drift of the odometry between two nodes, and the innovations of loops against it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array, Transform, adjoint, inverse, log, stride_for
from mapper.graph.model import BetweenFactor

MOST_TRIED = 8
"""Loops between the same two parts that are tried as their connection, and clusters of loops as outliers."""


def innovations(known: Sequence[BetweenFactor], loops: Sequence[BetweenFactor]) -> Array:
    """Return the squared Mahalanobis distance of each loop from the odometry's prediction.

    Along the spanning tree of the surest known factors, poses are chained and first-order covariances add
    up in the world's tangent space (Barfoot & Furgale 2014, eq. 55 without the fourth-order terms). The
    covariance grows with the path, so over a long one a large disagreement is likely. Parts that only loops
    connect are connected by the loop that the others between them fit best.

    Args:
        known: Factors that are inliers for certain.
        loops: Factors that may be outliers.

    Returns:
        (len(loops),) χ² of six degrees of freedom; 0 of a loop that connects two parts.
    """
    nodes = [node for loop in loops for node in (loop.i, loop.j)]
    tree = _spanning_tree(known, nodes)
    while between := tree.between_first_parts(loops):
        tried = between[:: stride_for(len(between), MOST_TRIED)]
        trees = [_spanning_tree([*known, connection], nodes) for connection in tried]
        best = min(range(len(tried)), key=lambda k: float(np.median([*map(trees[k].innovation, between)])))
        known, tree = [*known, tried[best]], trees[best]
    return np.array([tree.innovation(loop) for loop in loops])


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """A node in the tree.

    Attributes:
        root: First node of its tree.
        parent: The node before it; its own for the root.
        depth: Number of steps from the root.
        T_root_node: (4, 4) pose in the root, chained from it.
        covariance: (6, 6) accumulated since the root, in the root's tangent space.
    """

    root: int
    parent: int
    depth: int
    T_root_node: Transform
    covariance: Array


@dataclass(frozen=True, slots=True)
class _Tree:
    places: dict[int, _Place]

    def between_first_parts(self, loops: Sequence[BetweenFactor]) -> list[BetweenFactor]:
        """Return the loops between the same two trees as the first one that lies between any two."""
        by_parts: dict[frozenset[int], list[BetweenFactor]] = {}
        for loop in loops:
            if loop.i in self.places and loop.j in self.places:
                parts = frozenset((self.places[loop.i].root, self.places[loop.j].root))
                if len(parts) == 2:
                    by_parts.setdefault(parts, []).append(loop)
        return next(iter(by_parts.values()), [])

    def innovation(self, loop: BetweenFactor) -> float:
        i, j = self.places.get(loop.i), self.places.get(loop.j)
        if i is None or j is None or i.root != j.root:
            return 0.0
        common = self.places[self._common(loop.i, loop.j)]
        to_j = adjoint(inverse(j.T_root_node))
        drift = to_j @ (i.covariance + j.covariance - 2.0 * common.covariance) @ to_j.T
        error = np.concatenate(log(inverse(loop.T_i_j) @ inverse(i.T_root_node) @ j.T_root_node))
        return float(error @ np.linalg.solve(drift + np.linalg.inv(loop.information), error))

    def _common(self, a: int, b: int) -> int:
        """Return the deepest node on both paths to the root."""
        while a != b:
            if self.places[a].depth < self.places[b].depth:
                a, b = b, a
            a = self.places[a].parent
        return a


def _spanning_tree(factors: Sequence[BetweenFactor], others: Iterable[int]) -> _Tree:
    """Return the tree of the surest factors, grown from the first node of each component.

    Other nodes, without factors, are trees of their own.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree  # takes half a second

    places = {node: _root(node) for node in others}
    if not factors:
        return _Tree(places)
    for node in {node for factor in factors for node in (factor.i, factor.j)}:
        places.pop(node, None)
    covariances = np.linalg.inv(np.array([factor.information for factor in factors]))
    nodes = list(dict.fromkeys(node for factor in factors for node in (factor.i, factor.j)))
    index_of = {node: index for index, node in enumerate(nodes)}
    by_rank = np.argsort(np.trace(covariances, axis1=1, axis2=2), kind="stable").tolist()
    ends = np.sort([(index_of[factors[k].i], index_of[factors[k].j]) for k in by_rank], axis=1)
    _, surest = np.unique(ends, axis=0, return_index=True)  # of parallel factors
    ranks = coo_array((surest + 1.0, tuple(ends[surest].T)), shape=(len(nodes), len(nodes)))
    tree = minimum_spanning_tree(ranks)
    factor_of = {frozenset(ends[rank].tolist()): by_rank[rank] for rank in tree.data.astype(np.intp) - 1}
    for root, node in enumerate(nodes):
        if node in places:
            continue
        places[node] = _root(node)
        reached, before = breadth_first_order(tree, root, directed=False)
        for index in reached[1:].tolist():
            parent = int(before[index])
            k = factor_of[frozenset((index, parent))]
            places[nodes[index]] = _grown(
                places[nodes[parent]], nodes[parent], nodes[index], factors[k], covariances[k]
            )
    return _Tree(places)


def _root(node: int) -> _Place:
    return _Place(node, node, 0, np.eye(4), np.zeros((6, 6)))


def _grown(before: _Place, parent: int, node: int, factor: BetweenFactor, covariance: Array) -> _Place:
    T_parent_node = factor.T_i_j if factor.j == node else inverse(factor.T_i_j)
    T_root_node = before.T_root_node @ T_parent_node
    to_root = adjoint(T_root_node if factor.j == node else before.T_root_node)
    covariance = before.covariance + to_root @ covariance @ to_root.T
    return _Place(before.root, parent, before.depth + 1, T_root_node, covariance)
