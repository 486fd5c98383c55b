"""Initial poses by chordal relaxation, without estimates (Martinec & Pajdla 2007; Carlone et al. 2015)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mapper.core.errors import GraphError
from mapper.core.geometry import Array, nearest_rotation
from mapper.graph.config import GraphConfig
from mapper.graph.gtsam_factors import between, solver_errors
from mapper.graph.least_squares import Part, problem_of

if TYPE_CHECKING:
    import gtsam

_BAD_FIT = 100.0
"""Mean χ² of a factor beyond which estimates may be a poor start: 4 σ in each of six directions."""


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

    Rotations are relaxed to any (3, 3) matrices that fit R_j = R_i · R_i_j best, which binds every row of
    them alike, and projected back. With them fixed, positions are fitted to the measured translations.
    All factors weigh the same: some published information is too ill-conditioned for a linear solver.

    Raises:
        GraphError: A linear problem is singular.
    """
    import gtsam

    factors = (*part.known, *part.loops)
    nodes = part.start.keys()
    place = {node: k for k, node in enumerate(nodes)}
    kept = part.start.atPose3(part.fixed)
    turns, steps = gtsam.GaussianFactorGraph(), gtsam.GaussianFactorGraph()
    one, zero = np.eye(3), np.zeros(3)
    for factor in factors:
        turns.add(factor.i, -factor.T_i_j[:3, :3].T, factor.j, one, zero)
    with solver_errors(f"no chordal start from node {part.fixed}"):
        rows = [_solved(turns, nodes, part.fixed, row) for row in kept.rotation().matrix()]
        R_world_node = nearest_rotation(np.stack(rows, axis=1))
        for factor in factors:
            steps.add(factor.i, -one, factor.j, one, R_world_node[place[factor.i]] @ factor.T_i_j[:3, 3])
        positions = _solved(steps, nodes, part.fixed, kept.translation())
    values = gtsam.Values()
    for node, R, position in zip(nodes, R_world_node, positions, strict=True):
        values.insert(node, gtsam.Pose3(gtsam.Rot3(R), position))
    return values


def _solved(problem: gtsam.GaussianFactorGraph, nodes: list[int], fixed: int, known: Array) -> Array:
    """Return the (N, 3) vectors that solve a linear problem in which the fixed node's is known."""
    import gtsam

    held = gtsam.GaussianFactorGraph()
    held.push_back(problem)
    held.add(fixed, np.eye(3), known)
    solution = held.optimize()
    return np.array([solution.at(node) for node in nodes])


def _step(problem: gtsam.NonlinearFactorGraph, near: gtsam.Values) -> tuple[float, gtsam.Values]:
    """Return the error after one Gauss–Newton step, infinite where there is none, and where it led."""
    import gtsam

    optimizer = gtsam.GaussNewtonOptimizer(problem, near)
    try:
        optimizer.iterate()
    except RuntimeError:
        return np.inf, near
    return optimizer.error(), gtsam.Values(optimizer.values())
