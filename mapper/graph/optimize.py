"""Solve a pose graph with GTSAM, the one module that knows it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mapper.config.graph import GraphConfig
from mapper.errors import GraphError
from mapper.geometry import Array, Transform, is_rigid
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas, Solution

if TYPE_CHECKING:
    import gtsam

# The anchor only removes the freedom to move the whole component, so at the solution it costs nothing
# whatever its width; a far tighter one would spoil the conditioning for no gain.
_ANCHOR = PoseSigmas(rotation_rad=1e-3, translation_m=1e-3)

# χ² has no unit: once a step gains less than this, only rounding is left.
_ABSOLUTE_ERROR = 1e-10


def optimize(graph: PoseGraph, config: GraphConfig) -> Solution:
    """Return the poses that explain the factors best.

    Levenberg–Marquardt (Marquardt 1963) on ½ Σ ‖log(T_i_j⁻¹ · T_i⁻¹ · T_j)‖², each in its factor's metric.
    Every connected component is solved on its own and keeps its first node where it was; a node
    without factors keeps its estimate. With ``config.solve == "none"`` all estimates are returned as
    they are, and the errors tell how well they fit.

    Args:
        graph: At least one node; it is not changed.
        config: Which solve, and when to stop.

    Returns:
        The poses of every node in the graph's order; ``iterations`` sums over the components.

    Raises:
        GraphError: The graph has no nodes, an estimate is not a rigid motion, or the solver fails.
    """
    _refuse_unusable(graph)
    terms = [_between(factor) for factor in graph.factors]
    start = _values(graph.T_world_node)
    before = [term.error(start) for term in terms]
    if config.solve == "none":
        error = float(sum(before))
        return Solution(dict(graph.T_world_node), error, error, 0, tuple(before))

    T_world_node = dict(graph.T_world_node)
    after = list(before)
    iterations = 0
    for nodes, factors in _tied_components(graph):
        optimizer = _optimizer([terms[k] for k in factors], start, nodes=nodes, config=config)
        solved = _run(optimizer, nodes)
        iterations += optimizer.iterations()
        for node in nodes:
            T_world_node[node] = solved.atPose3(node).matrix()
        for k in factors:
            after[k] = terms[k].error(solved)
    return Solution(T_world_node, float(sum(before)), float(sum(after)), iterations, tuple(after))


def components(graph: PoseGraph) -> list[list[int]]:
    """Return the nodes of every connected component; the graph's order holds between and within them."""
    parent = {node: node for node in graph.T_world_node}

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for factor in graph.factors:
        parent[root(factor.j)] = root(factor.i)
    members: dict[int, list[int]] = {}
    for node in graph.T_world_node:
        members.setdefault(root(node), []).append(node)
    return list(members.values())


def _tied_components(graph: PoseGraph) -> list[tuple[list[int], list[int]]]:
    """Return (nodes, indices of their factors) of every component that has any factor."""
    parts = components(graph)
    part_of = {node: part for part, nodes in enumerate(parts) for node in nodes}
    factors: list[list[int]] = [[] for _ in parts]
    for k, factor in enumerate(graph.factors):
        factors[part_of[factor.i]].append(k)
    return [(nodes, indices) for nodes, indices in zip(parts, factors, strict=True) if indices]


def _refuse_unusable(graph: PoseGraph) -> None:
    if not graph.T_world_node:
        raise GraphError("the pose graph has no nodes, so there is nothing to solve; was any frame tracked?")
    if not is_rigid(np.array(list(graph.T_world_node.values()))):
        bad = next(node for node, T in graph.T_world_node.items() if not is_rigid(T))
        raise GraphError(f"node {bad}: its estimate is not a finite rigid motion; the graph cannot be solved")


def _optimizer(
    terms: list[gtsam.BetweenFactorPose3], start: gtsam.Values, *, nodes: list[int], config: GraphConfig
) -> gtsam.LevenbergMarquardtOptimizer:
    import gtsam

    problem, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for term in terms:
        problem.add(term)
    for node in nodes:
        values.insert(node, start.atPose3(node))
    first = nodes[0]
    problem.add(gtsam.PriorFactorPose3(first, start.atPose3(first), _noise(_ANCHOR.information)))

    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(config.max_iterations)
    parameters.setRelativeErrorTol(config.relative_error)
    parameters.setAbsoluteErrorTol(_ABSOLUTE_ERROR)
    return gtsam.LevenbergMarquardtOptimizer(problem, values, parameters)


def _run(optimizer: gtsam.LevenbergMarquardtOptimizer, nodes: list[int]) -> gtsam.Values:
    where = f"the graph of {len(nodes)} nodes from node {nodes[0]}"
    try:
        solved = optimizer.optimize()
    except RuntimeError as error:  # how GTSAM's C++ exceptions arrive, several lines long
        reason = " ".join(str(error).split())
        raise GraphError(f"{where} cannot be solved: {reason}") from None
    cost = optimizer.error()
    if not np.isfinite(cost):
        raise GraphError(f"{where} cannot be solved: its error became {cost}; look for absurd information")
    return solved


def _values(T_world_node: dict[int, Transform]) -> gtsam.Values:
    import gtsam

    values = gtsam.Values()
    for node, T in T_world_node.items():
        values.insert(node, _pose3(T))
    return values


def _between(factor: BetweenFactor) -> gtsam.BetweenFactorPose3:
    import gtsam

    return gtsam.BetweenFactorPose3(factor.i, factor.j, _pose3(factor.T_i_j), _noise(factor.information))


def _noise(information: Array) -> gtsam.noiseModel.Gaussian:
    """GTSAM orders the Pose3 tangent (rotation, translation), as we do; nothing else here relies on it."""
    import gtsam

    return gtsam.noiseModel.Gaussian.Information(0.5 * (information + information.T))


def _pose3(T_a_b: Transform) -> gtsam.Pose3:
    """GTSAM ends the whole process when a rotation is off SO(3) by rounding, so it is projected first."""
    import gtsam

    return gtsam.Pose3(gtsam.Rot3.ClosestTo(T_a_b[:3, :3]), T_a_b[:3, 3])
