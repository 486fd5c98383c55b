"""Initial poses by chordal relaxation, without estimates (Martinec & Pajdla 2007; Carlone et al. 2015)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mapper.core.errors import GraphError
from mapper.graph.config import GraphConfig
from mapper.graph.gtsam_factors import anchor, between, solver_errors
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
