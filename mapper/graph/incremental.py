"""Incremental solver of a growing pose graph: iSAM2 (Kaess et al. 2012) by GTSAM."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from mapper.core.errors import GraphError
from mapper.core.geometry import Transform, inverse
from mapper.graph.config import GraphConfig
from mapper.graph.gtsam_factors import Kernel, anchor, between, poses_of, values_of
from mapper.graph.model import BetweenFactor, refuse_factor, refuse_node

_HUBER = Kernel("huber", GraphConfig().robust_width)
_LARGEST_RATIO = 1e16
"""Largest ratio of information that double precision can still add up."""


class IncrementalSolver:
    """Current poses of a growing graph. Loops are under Huber's kernel, which never ignores one altogether.

    Nodes and factors are pending until ``update``, nodes without factors also after it; a pending node has
    its first estimate. Every connected component keeps its first node at its first estimate. When a loop
    joins two components, the later is moved to the earlier; if both are solved, they are solved again.
    """

    def __init__(self) -> None:
        self._T_world_node: dict[int, Transform] = {}
        self._factors: list[BetweenFactor] = []
        self._component: dict[int, int] = {}
        self._members: dict[int, list[int]] = {}
        self._factorization = "CHOLESKY"
        self._restart()

    def _restart(self) -> None:
        """Drop the solution: everything is pending."""
        import gtsam

        parameters = gtsam.ISAM2Params()
        parameters.setFactorization(self._factorization)
        self._isam = gtsam.ISAM2(parameters)
        self._solved: set[int] = set()
        self._anchored: set[int] = set()
        self._used = 0
        self._is_read = True

    def add_node(self, node: int, T_world_node: Transform) -> None:
        """Add a node with its first estimate.

        Raises:
            GraphError: The node is there already, or the estimate is not a rigid motion.
        """
        refuse_node(node, T_world_node, self._T_world_node)
        self._T_world_node[node] = T_world_node
        self._component[node], self._members[node] = node, [node]

    def add_factors(self, factors: Iterable[BetweenFactor]) -> None:
        """Add measurements between nodes that exist.

        Raises:
            GraphError: A factor names an unknown node.
        """
        for factor in factors:
            refuse_factor(factor, self._T_world_node)
            if self._component[factor.i] != self._component[factor.j]:
                self._join(factor)
            self._factors.append(factor)

    def update(self) -> None:
        """Solve with all that is pending.

        Raises:
            GraphError: The factors do not determine the poses; look for absurd information.
        """
        import gtsam

        pending = self._factors[self._used :]
        if not pending:
            return
        terms = gtsam.NonlinearFactorGraph()
        connected: dict[int, None] = {}
        for factor in pending:
            terms.add(between(factor, kernel=_HUBER if factor.origin == "loop" else None))
            connected |= dict.fromkeys((factor.i, factor.j))
        for first in dict.fromkeys(self._component[node] for node in connected):
            if first not in self._anchored:
                terms.add(anchor(first, self._T_world_node[first]))
                self._anchored.add(first)
        new = [node for node in connected if node not in self._solved]
        try:
            self._isam.update(terms, values_of(self._T_world_node, new))
            if any(factor.origin == "loop" for factor in pending):
                self._isam.update()  # a loop moves poses farther than one linearisation holds
        except RuntimeError as error:  # how GTSAM's C++ exceptions arrive, several lines long
            if self._factorization == "CHOLESKY" and _are_commensurable(self._factors):
                self._factorization = "QR"  # Cholesky takes chains of a thousand nodes for indeterminate
                self._restart()
                self.update()
                return
            raise GraphError(f"the growing graph cannot be solved: {' '.join(str(error).split())}") from None
        self._solved |= connected.keys()
        self._used = len(self._factors)
        self._is_read = False

    def pose_of(self, node: int) -> Transform:
        """Return the (4, 4) current estimate of a node's pose.

        Raises:
            GraphError: The node is unknown.
        """
        if node not in self._T_world_node:
            raise GraphError(f"node {node} is not in the graph")
        if node in self._solved and not self._is_read:
            return self._isam.calculateEstimatePose3(node).matrix()
        return self._T_world_node[node]

    def poses(self) -> dict[int, Transform]:
        """Return the (4, 4) current estimate of every node's pose, in the order in which they were added."""
        if not self._is_read:
            self._T_world_node |= poses_of(self._isam.calculateEstimate())
            self._is_read = True
        return dict(self._T_world_node)

    def _join(self, factor: BetweenFactor) -> None:
        """Make one component of the two that a factor connects."""
        two = self._component[factor.i], self._component[factor.j]
        older, younger = (first for first in self._members if first in two)
        joining = self._members.pop(younger)
        both_solved = older in self._anchored and younger in self._anchored
        if both_solved or factor.origin == "loop":  # a new node is placed by its first factor
            self._move(joining, factor)
        if both_solved:
            self._restart()
        for node in joining:
            self._component[node] = older
        self._members[older] += joining

    def _move(self, joining: list[int], factor: BetweenFactor) -> None:
        """Move one side of a factor so that the factor fits."""
        T_world_node = self.poses()
        if factor.j in joining:
            T_fitting_world = T_world_node[factor.i] @ factor.T_i_j @ inverse(T_world_node[factor.j])
        else:
            T_fitting_world = T_world_node[factor.j] @ inverse(T_world_node[factor.i] @ factor.T_i_j)
        self._T_world_node |= {node: T_fitting_world @ T_world_node[node] for node in joining}


def _are_commensurable(factors: Sequence[BetweenFactor]) -> bool:
    """Return whether rounding leaves something of the least information beside the largest."""
    eigenvalues = np.linalg.eigvalsh([factor.information for factor in factors])
    return bool(eigenvalues.max() < _LARGEST_RATIO * eigenvalues.min())
