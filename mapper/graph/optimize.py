"""Batch optimisation of a pose graph: each connected component on its own, loops with outlier rejection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mapper.core.errors import GraphError
from mapper.core.geometry import is_rigid
from mapper.graph.components import components_with_factors
from mapper.graph.config import GraphConfig
from mapper.graph.gtsam_factors import anchor, between, gauge, poses_of, solver_errors, values_of
from mapper.graph.least_squares import Part, PartSolution, problem_of
from mapper.graph.model import PoseGraph, Solution
from mapper.graph.proportional_correction import distribute
from mapper.graph.robust import solve_part
from mapper.runtime.progress import SILENT, Progress

if TYPE_CHECKING:
    import gtsam
_BAD_FIT = 100.0
"""Mean χ² of a factor beyond which estimates may be a poor start: 4 σ in each of six directions."""


def optimize(graph: PoseGraph, config: GraphConfig, *, progress: Progress = SILENT) -> Solution:
    """Return the poses that explain the factors best.

    Least squares on ½ Σ w ‖log(T_i_j⁻¹ · T_i⁻¹ · T_j)‖², each in its factor's metric; w is 1 but for loops,
    which ``config.robust`` weighs. Every connected component is solved on its own and
    keeps its first node where it was, or of ``graph.fixed`` the first that is in it, unless positions of its
    nodes were measured; a node without factors keeps its estimate.

    With ``config.solve == "proportional"`` the loops are spread along the path instead, and with "none"
    all estimates are returned as they are; the errors show how well they fit.

    Args:
        graph: Graph of at least one node; it is not changed.
        config: Solver, and when it stops.
        progress: Receives the iterations of each component, and how many there may be.

    Returns:
        The poses of every node in the graph's order; ``iterations`` sums over the components.

    Raises:
        GraphError: The graph has no nodes, an estimate is not a rigid motion, or the solver fails.
    """
    _refuse_unusable(graph)
    terms = [between(factor) for factor in graph.factors]
    given = values_of(graph.T_world_node, graph.T_world_node)
    before = _errors(terms, given)
    weights, iterations = np.ones(len(terms)), 0
    match config.solve:
        case "none":
            T_world_node = dict(graph.T_world_node)
        case "proportional":
            T_world_node = distribute(graph)
        case "batch":
            T_world_node = dict(graph.T_world_node)
            for nodes, factors in components_with_factors(graph):
                loops = [k for k in factors if graph.factors[k].origin == "loop"]
                known = [k for k in factors if graph.factors[k].origin != "loop"]
                fixed = _fixed_node(graph, nodes, progress)
                part = Part(
                    known=[graph.factors[k] for k in known],
                    loops=[graph.factors[k] for k in loops],
                    held=[*(terms[k] for k in known), *gauge(graph, set(nodes), fixed)],
                    start=given if len(nodes) == given.size() else values_of(graph.T_world_node, nodes),
                    fixed=fixed,
                )
                solved = _solve_component(part, config, progress)
                T_world_node |= poses_of(solved.poses)
                iterations += solved.iterations
                weights[loops] = solved.loop_weights
    after = _errors(terms, values_of(T_world_node, T_world_node))
    return Solution(T_world_node, iterations, before, after, tuple(weights.tolist()))


def _solve_component(part: Part, config: GraphConfig, progress: Progress) -> PartSolution:
    """Return what ``solve_part`` does from the configured start, with a note if it did not converge."""
    part, last = replace(part, start=start_of(part, config)), 0
    with progress.stage("solve") as report:

        def watched(done: int, total: int) -> None:
            nonlocal last
            last = done
            report(done, total)

        solution = solve_part(part, config, report=watched)
    if last >= config.max_iterations:
        progress.note(
            f"the solve of {part.start.size()} nodes was ended by max_iterations={config.max_iterations}, "
            "not by convergence; raise it"
        )
    return solution


def _errors(terms: Sequence[gtsam.NonlinearFactor], values: gtsam.Values) -> tuple[float, ...]:
    return tuple(term.error(values) for term in terms)


def _fixed_node(graph: PoseGraph, nodes: Sequence[int], progress: Progress) -> int:
    """Return the node of a component that keeps its pose."""
    among = set(nodes)
    fixed = [node for node in graph.fixed if node in among]
    if len(fixed) > 1:
        progress.note(f"of {len(fixed)} connected nodes that are fixed only node {fixed[0]} keeps its pose")
    return fixed[0] if fixed else nodes[0]


def _refuse_unusable(graph: PoseGraph) -> None:
    if not graph.T_world_node:
        raise GraphError("the pose graph has no nodes, so there is nothing to solve; was any frame tracked?")
    if not is_rigid(np.array(list(graph.T_world_node.values()))):
        bad = next(node for node, T in graph.T_world_node.items() if not is_rigid(T))
        raise GraphError(f"node {bad}: its estimate is not a finite rigid motion; the graph cannot be solved")


def start_of(part: Part, config: GraphConfig) -> gtsam.Values:
    """Return the initial poses, chosen by ``config.initial``.

    "auto" keeps the estimates if they fit, or if loops may be outliers, which would spoil the relaxation.
    Otherwise it takes the relaxation if its cost is lower. If it is higher, both are compared after one
    Gauss–Newton step: before it, a start with all rotations right can cost more than one with none.

    Raises:
        GraphError: A chordal start is required, and there is none.
    """
    if config.initial == "given":
        return part.start
    if config.initial == "chordal":
        return chordal_start(part)
    if part.loops and config.robust != "none":
        return part.start
    problem = problem_of((*part.held, *(between(loop) for loop in part.loops)))
    cost = problem.error(part.start)
    if 2.0 * cost <= _BAD_FIT * problem.size():
        return part.start
    try:
        relaxed = chordal_start(part)
    except GraphError:
        return part.start
    if problem.error(relaxed) < cost:
        return relaxed
    return min((_step(problem, near) for near in (part.start, relaxed)), key=lambda step: step[0])[1]


def chordal_start(part: Part) -> gtsam.Values:
    """Return poses of one connected component from its factors and its fixed node's estimate.

    Rotations are relaxed to any (3, 3) matrices that fit R_j = R_i · R_i_j best, and projected back; one
    Gauss–Newton step from them gives the positions. All factors weigh the same: some published information is
    too ill-conditioned for a linear solver.

    Raises:
        GraphError: A linear problem is singular.
    """
    import gtsam

    alike = [between(replace(factor, information=np.eye(6))) for factor in (*part.known, *part.loops)]
    held = anchor(part.fixed, part.start.atPose3(part.fixed).matrix())
    with solver_errors(f"no chordal start from node {part.fixed}"):
        return gtsam.InitializePose3.initialize(problem_of([*alike, held]))


def _step(problem: gtsam.NonlinearFactorGraph, near: gtsam.Values) -> tuple[float, gtsam.Values]:
    """Return the error after one Gauss–Newton step, infinite where there is none, and where it led."""
    import gtsam

    optimizer = gtsam.GaussNewtonOptimizer(problem, near)
    try:
        optimizer.iterate()
    except RuntimeError:
        return np.inf, near
    return optimizer.error(), gtsam.Values(optimizer.values())
