"""Pose graph: nodes, relative-pose factors, and the solution."""

from collections.abc import Container, Iterable
from dataclasses import dataclass, field, replace
from operator import mul
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import GraphError
from mapper.core.geometry import Array, Points, Transform, is_rigid

if TYPE_CHECKING:
    import gtsam

Origin = Literal["odometry", "loop", "wheel"]


@dataclass(frozen=True, slots=True)
class PoseSigmas:
    """Isotropic standard deviations of a relative pose."""

    rotation_rad: float
    translation_m: float

    def __post_init__(self) -> None:
        if not (0.0 < self.rotation_rad < np.inf and 0.0 < self.translation_m < np.inf):
            raise GraphError(
                f"noise of {self.rotation_rad} rad and {self.translation_m} m: both must be finite and > 0"
            )

    @property
    def information(self) -> Array:
        """(6, 6) information matrix of the tangent (rotation, translation)."""
        return np.diag([self.rotation_rad**-2.0] * 3 + [self.translation_m**-2.0] * 3)


@dataclass(frozen=True, slots=True, eq=False)
class BetweenFactor:
    """A measured relative pose.

    Attributes:
        i: Node that the measurement is expressed in (the registration's target).
        j: Node that is measured (the registration's source).
        T_i_j: (4, 4) measured pose of j in i.
        information: (6, 6) Fisher information of j's tangent (rotation, translation): rad⁻², m⁻².
        origin: Kind of measurement.
    """

    i: int
    j: int
    T_i_j: Transform
    information: Array = field(repr=False)
    origin: Origin = "odometry"

    def __post_init__(self) -> None:
        if self.i == self.j:
            raise GraphError(f"factor {self.i} → {self.j}: a node cannot be measured against itself")
        if not is_rigid(self.T_i_j):
            raise GraphError(f"factor {self.i} → {self.j}: T_i_j is not a finite rigid motion")
        if self.information.shape != (6, 6) or not np.isfinite(self.information).all():
            raise GraphError(f"factor {self.i} → {self.j}: information must be a finite (6, 6) matrix")
        try:
            np.linalg.cholesky(0.5 * (self.information + self.information.T))
        except np.linalg.LinAlgError:
            raise GraphError(f"factor {self.i} → {self.j}: information is not positive definite") from None

    def renumbered(self, offset: int) -> "BetweenFactor":
        """Return the factor with a constant added to its node numbers."""
        return replace(self, i=self.i + offset, j=self.j + offset)


@dataclass(frozen=True, slots=True, eq=False)
class PositionFactor:
    """A measured position of a point that moves with a node, such as a GNSS antenna's.

    Attributes:
        node: Node that carries the point.
        point_node: (3,) the point in the node, metres.
        position_world: (3,) its measured position, metres.
        information: (3, 3) of the measurement along the world's axes, m⁻².
        weight: Share of the information that counts: consecutive measurements have errors in common.
        stamp_ns: Time of the measurement, nanoseconds.
    """

    node: int
    point_node: Array
    position_world: Array
    information: Array = field(repr=False)
    weight: float = 1.0
    stamp_ns: int = 0

    def moved(self, T_new_world: Transform) -> "PositionFactor":
        """Return the same measurement in another world frame."""
        R = T_new_world[:3, :3]
        position = R @ self.position_world + T_new_world[:3, 3]
        return replace(self, position_world=position, information=R @ self.information @ R.T)


@dataclass(slots=True)
class PoseGraph:
    """Nodes with their estimates, and the factors between them. Grows while a log is tracked.

    Attributes:
        T_world_node: Pose of every node.
        stamps_ns: Time of every node.
        factors: Measurements between nodes.
        fixed: Nodes that a solve leaves where they are, in place of each component's first.
        fixes: Measured positions; a component with any has no fixed node, and the world's z is up.
    """

    T_world_node: dict[int, Transform] = field(default_factory=dict)
    stamps_ns: dict[int, int] = field(default_factory=dict)
    factors: list[BetweenFactor] = field(default_factory=list)
    fixed: tuple[int, ...] = ()
    fixes: tuple[PositionFactor, ...] = ()

    def __repr__(self) -> str:
        nodes, factors = len(self.T_world_node), len(self.factors)
        return f"PoseGraph of {nodes} nodes and {factors} factors, {len(self.loops)} of them loops"

    @property
    def nodes(self) -> NDArray[np.int64]:
        """(N,) numbers of the nodes, in the order in which they were added."""
        return np.fromiter(self.T_world_node, np.int64, len(self.T_world_node))

    @property
    def poses(self) -> Array:
        """(N, 4, 4) poses of ``nodes`` in the world."""
        return np.array(list(self.T_world_node.values())).reshape(-1, 4, 4)

    @property
    def positions(self) -> Points:
        """(N, 3) positions of ``nodes``, metres, world frame."""
        return self.poses[:, :3, 3]

    @property
    def loops(self) -> list[BetweenFactor]:
        """Factors that are loops."""
        return [factor for factor in self.factors if factor.origin == "loop"]

    @property
    def loops_world(self) -> Array:
        """(L, 2, 3) positions of the two nodes that each loop connects, metres, world frame."""
        ends = [[self.T_world_node[node][:3, 3] for node in (loop.i, loop.j)] for loop in self.loops]
        return np.array(ends).reshape(-1, 2, 3)

    def to_gtsam(self) -> "tuple[gtsam.NonlinearFactorGraph, gtsam.Values]":
        """Return the factors and the estimates as GTSAM's, keyed by node; a prior holds one node.

        Every factor is a ``BetweenFactorPose3`` with Gaussian noise; its tangent is ordered (rotation,
        translation), as here.
        """
        from mapper.graph.gtsam_factors import anchor, between, values_of
        from mapper.graph.least_squares import problem_of

        first = next(iter((*self.fixed, *self.T_world_node)), None)
        priors = [] if first is None else [anchor(first, self.T_world_node[first])]
        terms = [*priors, *(between(factor) for factor in self.factors)]
        return problem_of(terms), values_of(self.T_world_node, self.T_world_node)

    def add_node(self, node: int, stamp_ns: int, T_world_node: Transform) -> None:
        """Add a node with its first estimate.

        Raises:
            GraphError: The node exists, or the estimate is not a rigid motion.
        """
        refuse_node(node, T_world_node, self.T_world_node)
        self.T_world_node[node] = T_world_node
        self.stamps_ns[node] = stamp_ns

    def moved(self, T_new_world: Transform) -> "PoseGraph":
        """Return the graph in another world frame; its relative measurements are the same."""
        moved = self.with_poses({node: T_new_world @ T for node, T in self.T_world_node.items()})
        return replace(moved, fixes=tuple(factor.moved(T_new_world) for factor in self.fixes))

    def with_poses(self, T_world_node: dict[int, Transform]) -> "PoseGraph":
        """Return the graph with other poses of the same nodes."""
        return replace(self, T_world_node=T_world_node)

    @property
    def has_wheels(self) -> bool:
        """Whether wheels measured any of its factors."""
        return any(factor.origin == "wheel" for factor in self.factors)

    def with_factors(self, factors: Iterable[BetweenFactor]) -> "PoseGraph":
        """Return the graph with these factors in place of its own."""
        return replace(self, factors=list(factors))

    def without_loops(self) -> "PoseGraph":
        """Return the graph with the factors of odometry and wheels alone."""
        return self.with_factors(factor for factor in self.factors if factor.origin != "loop")

    def with_loops(self, loops: Iterable[BetweenFactor]) -> "PoseGraph":
        """Return the graph with these loops in place of its own, after all other factors."""
        return self.with_factors([*self.without_loops().factors, *loops])

    def part(self, nodes: Container[int]) -> "PoseGraph":
        """Return the graph of some nodes, with the factors between them."""
        return PoseGraph(
            {node: T for node, T in self.T_world_node.items() if node in nodes},
            {node: stamp_ns for node, stamp_ns in self.stamps_ns.items() if node in nodes},
            [factor for factor in self.factors if factor.i in nodes and factor.j in nodes],
            tuple(node for node in self.fixed if node in nodes),
            tuple(factor for factor in self.fixes if factor.node in nodes),
        )

    def add_factors(self, factors: Iterable[BetweenFactor]) -> None:
        """Add measurements between nodes that exist.

        Raises:
            GraphError: A factor names an unknown node.
        """
        for factor in factors:
            refuse_factor(factor, self.T_world_node)
            self.factors.append(factor)


def refuse_node(node: int, T_world_node: Transform, known: Container[int]) -> None:
    """Refuse a new node that is among the known ones, or whose pose is not a rigid motion."""
    if node in known:
        raise GraphError(f"node {node} is in the graph already")
    if not is_rigid(T_world_node):
        raise GraphError(f"node {node}: its pose is not a finite rigid motion")


def refuse_factor(factor: BetweenFactor, known: Container[int]) -> None:
    """Refuse a factor of which a node is not among the known ones."""
    for node in (factor.i, factor.j):
        if node not in known:
            raise GraphError(f"factor {factor.i} → {factor.j}: node {node} is not in the graph")


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Solution of a pose graph; factors are in the graph's order.

    Attributes:
        T_world_node: Solved pose of every node.
        iterations: Solver iterations.
        factor_errors_before: ½ χ² of each factor at the first estimates.
        factor_errors: ½ χ² of each factor at the solution.
        weights: Final weight of each factor, 0 … 1; only loops can have less than 1.
    """

    T_world_node: dict[int, Transform]
    iterations: int
    factor_errors_before: tuple[float, ...]
    factor_errors: tuple[float, ...]
    weights: tuple[float, ...]

    @property
    def error_before(self) -> float:
        """Σ weight · ½ χ² at the first estimates."""
        return float(sum(map(mul, self.weights, self.factor_errors_before)))

    @property
    def error_after(self) -> float:
        """Σ weight · ½ χ² at the solution."""
        return float(sum(map(mul, self.weights, self.factor_errors)))
