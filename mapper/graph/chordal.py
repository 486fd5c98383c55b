"""A start that needs no estimates: chordal relaxation (Martinec & Pajdla 2007; Carlone et al. 2015)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mapper.config.graph import GraphConfig
from mapper.errors import GraphError
from mapper.geometry import transform
from mapper.graph.batch import Part, problem_of
from mapper.graph.model import BetweenFactor
from mapper.graph.terms import between, values_of

if TYPE_CHECKING:
    import gtsam

_BAD_FIT = 100.0
"""Mean χ² of a factor beyond which estimates may be a poor start: 4 σ in each of six directions."""


def start_of(part: Part, config: GraphConfig) -> gtsam.Values:
    """Return where the solver shall begin, as ``config.initial`` says.

    "auto" stays with the estimates if they fit, or if loops are in doubt, which would spoil the relaxation.
    Otherwise it takes a step from both and goes on from the better: before that step, a start with all
    rotations right can look worse than one with none.

    Raises:
        GraphError: A chordal start is asked for, and there is none.
    """
    if config.initial == "given":
        return part.start
    if config.initial == "chordal":
        return chordal_start([*part.known, *part.loops], part.start)
    if part.loops and config.robust != "none":
        return part.start
    terms = [*part.held, *(between(loop) for loop in part.loops)]
    if 2.0 * sum(term.error(part.start) for term in terms) <= _BAD_FIT * len(terms):
        return part.start
    try:
        relaxed = chordal_start([*part.known, *part.loops], part.start)
    except GraphError:
        return part.start
    problem = problem_of(terms)
    return min((_step(problem, near) for near in (part.start, relaxed)), key=lambda step: step[0])[1]


def chordal_start(factors: Sequence[BetweenFactor], given: gtsam.Values) -> gtsam.Values:
    """Return poses of one connected component from its factors, in two linear problems.

    Rotations are relaxed to any (3, 3) matrices, fitted to the measured ones and projected back. With them
    fixed, positions are fitted to the measured translations, all of which weigh the same: some
    published information is too ill-conditioned for a linear solver.

    Args:
        factors: Of the component.
        given: Its estimates; only that of the first node counts.

    Raises:
        GraphError: A linear problem is singular.
    """
    import gtsam

    nodes = given.keys()
    first = given.atPose3(nodes[0])
    held = gtsam.PriorFactorPose3(nodes[0], first, gtsam.noiseModel.Unit.Create(6))
    problem = problem_of((held, *(between(factor) for factor in factors)))
    try:
        rotations = gtsam.InitializePose3.computeOrientationsChordal(
            gtsam.InitializePose3.buildPose3graph(problem)
        )
        R_world_node = {node: rotations.atRot3(node).matrix() for node in nodes}
        steps = gtsam.GaussianFactorGraph()
        identity = np.eye(3)
        steps.add(nodes[0], identity, first.translation())
        for factor in factors:
            step_world = R_world_node[factor.i] @ factor.T_i_j[:3, 3]
            steps.add(factor.i, -identity, factor.j, identity, step_world)
        positions = steps.optimize()
    except RuntimeError as error:  # how GTSAM's C++ exceptions arrive, several lines long
        raise GraphError(f"no chordal start from node {nodes[0]}: {' '.join(str(error).split())}") from None
    poses = {node: transform(R_world_node[node], positions.at(node)) for node in nodes}
    return values_of(poses, nodes)


def _step(problem: gtsam.NonlinearFactorGraph, near: gtsam.Values) -> tuple[float, gtsam.Values]:
    """Return the error after one Gauss–Newton step, infinite where there is none, and where it led."""
    import gtsam

    optimizer = gtsam.GaussNewtonOptimizer(problem, near)
    try:
        optimizer.iterate()
    except RuntimeError:
        return np.inf, near
    return optimizer.error(), gtsam.Values(optimizer.values())
