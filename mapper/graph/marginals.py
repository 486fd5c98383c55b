"""Marginal covariances of a pose graph's nodes, each connected component's first node held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, adjoint, inverse
from mapper.graph.components import components_with_factors
from mapper.graph.gtsam_factors import anchor, between, position, solver_errors, values_of
from mapper.graph.least_squares import problem_of
from mapper.graph.model import PoseGraph, PoseSigmas

if TYPE_CHECKING:
    import gtsam

_HELD = PoseSigmas(rotation_rad=1e-6, translation_m=1e-6).information
"""Information of the first node: far less than any factor's, and yet within the digits of a solve."""
_DIMENSION = 6


@dataclass(frozen=True, slots=True, eq=False)
class Marginals:
    """Covariances of a pose graph, given all of its factors; rad² and m².

    Attributes:
        nodes: (6, 6) of every node's pose, tangent of the node (rotation, translation), the first node of its
            component being held, whose covariance is zero.
        relative: (6, 6) of the pose of j in i, tangent of j, for every factor's (i, j).
    """

    nodes: dict[int, Array]
    relative: dict[tuple[int, int], Array]


def marginals_of(graph: PoseGraph) -> Marginals:
    """Return the covariances of a graph's nodes, and of the nodes that factors tie relative to each other.

    The information is linearised where the nodes are; of its inverse
    only the blocks of nodes that share a clique are computed (Takahashi, Fagan & Chin 1973; on cliques as in
    Kaess & Dellaert 2009, §4), since the whole inverse is dense.

    Raises:
        GraphError: Some node is not determined.
    """
    import gtsam

    covariances = {node: np.zeros((_DIMENSION, _DIMENSION)) for node in graph.T_world_node}
    relative: dict[tuple[int, int], Array] = {}
    for nodes, indices in components_with_factors(graph):
        known = [graph.factors[k] for k in indices]
        measured = [position(factor) for factor in graph.fixes if factor.node in set(nodes)]
        held = anchor(nodes[0], graph.T_world_node[nodes[0]], _HELD)
        problem = problem_of([*map(between, known), *measured, held])
        linear = problem.linearize(values_of(graph.T_world_node, nodes))
        with solver_errors(f"covariances of {len(nodes)} nodes from node {nodes[0]}"):
            net = linear.eliminateSequential(gtsam.Ordering.ColamdGaussianFactorGraph(linear))
        pairs = list(dict.fromkeys((factor.i, factor.j) for factor in known))
        blocks = _recover(_supernodes([net.at(k) for k in range(net.size())]), pairs)
        covariances |= {node: blocks[node, node] for node in nodes[1:]}
        for i, j in pairs:
            to_j = adjoint(inverse(graph.T_world_node[j]) @ graph.T_world_node[i])
            across = to_j @ blocks[i, j]
            of_j_in_i = to_j @ blocks[i, i] @ to_j.T + blocks[j, j] - across - across.T
            relative[i, j] = 0.5 * (of_j_in_i + of_j_in_i.T)
    return Marginals(covariances, relative)


@dataclass(frozen=True, slots=True, eq=False)
class _Supernode:
    """Consecutive nodes of the elimination that depend on the same later ones.

    Attributes:
        nodes: The eliminated nodes, and the later nodes that they depend on.
        R: (6f, 6f) upper triangular: the square root of the information of the f eliminated nodes.
        S: (6f, 6s) the same towards the s later ones.
        parent: Number of the supernode that holds all of the later ones; None of the last.
    """

    nodes: Sequence[int]
    R: Array
    S: Array
    parent: int | None


def _supernodes(conditionals: Sequence[gtsam.GaussianConditional]) -> list[_Supernode]:
    """Return the supernodes of an elimination, the last eliminated first."""
    turn = {conditional.keys()[0]: k for k, conditional in enumerate(conditionals)}
    later = [sorted(conditional.keys()[1:], key=turn.__getitem__) for conditional in conditionals]
    groups: list[list[int]] = []  # of turns, the last eliminated first
    group_of: dict[int, int] = {}
    for k in reversed(range(len(conditionals))):
        after = turn[later[k][0]] if later[k] else -1
        if after >= 0 and groups[group_of[after]][-1] == after and later[k][1:] == later[after]:
            groups[group_of[after]].append(k)
            group_of[k] = group_of[after]
        else:
            group_of[k] = len(groups)
            groups.append([k])
    made = []
    for group in groups:
        turns = group[::-1]
        front = [conditionals[k].keys()[0] for k in turns]
        behind = later[turns[-1]]
        nodes = [*front, *behind]
        rows = np.zeros((_DIMENSION * len(front), _DIMENSION * len(nodes)))
        place = {node: index for index, node in enumerate(nodes)}
        for index, k in enumerate(turns):
            block = slice(_DIMENSION * index, _DIMENSION * (index + 1))
            rows[block, block] = conditionals[k].R()
            parents = [place[node] for node in conditionals[k].keys()[1:]]
            if parents:
                rows[block, _scalars(parents)] = conditionals[k].S()
        split = _DIMENSION * len(front)
        parent = group_of[turn[behind[0]]] if behind else None
        made.append(_Supernode(nodes, rows[:, :split], rows[:, split:], parent))
    return made


def _recover(
    supernodes: Sequence[_Supernode], pairs: Sequence[tuple[int, int]]
) -> dict[tuple[int, int], Array]:
    """Return the diagonal blocks of (RᵀR)⁻¹ and those of some pairs, from the last eliminated supernode down.

    Nodes that a factor connects share a supernode: that of the one which is eliminated first.
    """
    known: list[Array] = []
    blocks = {}
    pairs_of: dict[int, list[tuple[int, int]]] = {}
    for pair in pairs:
        for node in pair:
            pairs_of.setdefault(node, []).append(pair)
    for supernode in supernodes:
        front, behind = len(supernode.R), supernode.S.shape[1]
        R_inverse = np.linalg.inv(supernode.R)
        covariance = np.empty((front + behind, front + behind))
        covariance[:front, :front] = R_inverse @ R_inverse.T
        if supernode.parent is not None:
            place = {node: index for index, node in enumerate(supernodes[supernode.parent].nodes)}
            scalars = _scalars([place[node] for node in supernode.nodes[front // _DIMENSION :]])
            of_behind = known[supernode.parent][np.ix_(scalars, scalars)]
            share = R_inverse @ supernode.S
            across = -share @ of_behind
            covariance[:front, :front] -= across @ share.T
            covariance[:front, front:], covariance[front:, :front] = across, across.T
            covariance[front:, front:] = of_behind
        known.append(covariance)
        part = {
            node: slice(_DIMENSION * index, _DIMENSION * (index + 1))
            for index, node in enumerate(supernode.nodes)
        }
        for node in supernode.nodes[: front // _DIMENSION]:
            own = covariance[part[node], part[node]]
            blocks[node, node] = 0.5 * (own + own.T)
            for i, j in pairs_of.get(node, ()):
                if i in part and j in part:
                    blocks[i, j] = covariance[part[i], part[j]]
    return blocks


def _scalars(blocks: Sequence[int]) -> NDArray[np.int64]:
    """Return the indices of the rows of some nodes."""
    first = _DIMENSION * np.asarray(blocks, np.int64)
    return (first[:, np.newaxis] + np.arange(_DIMENSION)).ravel()
