"""Least-squares problems of GTSAM's factors, and the descent that solves them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from mapper.core.errors import GraphError
from mapper.graph.gtsam_factors import solver_errors
from mapper.runtime.progress import Report

if TYPE_CHECKING:
    import gtsam

    from mapper.core.geometry import Array
    from mapper.graph.model import BetweenFactor

# χ² has no unit: once a step gains less than this, only rounding is left.
_ABSOLUTE_ERROR = 1e-10


@dataclass(frozen=True, slots=True)
class Effort:
    """Termination criteria: a number of iterations, or an improvement below this share of the error.

    Attributes:
        report: Receives the iterations done, and how many there may be; in the end, how many there were.
    """

    max_iterations: int
    relative_error: float = 1e-8
    report: Report = lambda _done, _total: None


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """One connected part of a pose graph.

    Attributes:
        known: Its factors that are inliers for certain.
        loops: Its factors that may be outliers.
        held: GTSAM's terms of ``known``, and the anchor.
        start: Poses at which the solver starts.
        fixed: Node that keeps its pose.
    """

    known: Sequence[BetweenFactor]
    loops: Sequence[BetweenFactor]
    held: Sequence[gtsam.NonlinearFactor]
    start: gtsam.Values
    fixed: int


@dataclass(frozen=True, slots=True, eq=False)
class PartSolution:
    """Solution of one connected part.

    Attributes:
        poses: Poses of its nodes.
        loop_weights: (L,) weight of each of its loops, 0 … 1.
        iterations: Iterations that it took.
    """

    poses: gtsam.Values
    loop_weights: Array
    iterations: int


def solve(
    terms: Iterable[gtsam.NonlinearFactor],
    more_terms: Iterable[gtsam.NonlinearFactor],
    start: gtsam.Values,
    *,
    effort: Effort,
) -> tuple[gtsam.Values, int]:
    """Minimise the sum of all terms.

    Gauss–Newton as long as every step improves, for its steps take half the time; where one does not,
    Levenberg–Marquardt (Marquardt 1963) from there. Its steps are solved by Cholesky's factors or, where
    these are too inaccurate, as for straight paths of a thousand nodes, by orthogonal ones.

    Args:
        terms: GTSAM's factors.
        more_terms: Further ones, so that neither list is copied.
        start: Poses of all nodes to begin with.
        effort: When to end.

    Returns:
        The solution and the iterations it took.

    Raises:
        GraphError: The solver fails, or its error becomes infinite.
    """
    import gtsam

    problem = problem_of(chain(terms, more_terms))
    where = f"the graph of {start.size()} nodes from node {min(start.keys())}"
    with solver_errors(f"{where} cannot be solved"):
        quick = _quick_descent(problem, start, effort)
        if not quick.rose:
            return quick.values, quick.iterations
        parameters = gtsam.LevenbergMarquardtParams()
        # A step that would raise the error by less than this share ends GTSAM's search for a damping.
        parameters.setRelativeErrorTol(min(effort.relative_error, parameters.getRelativeErrorTol()))
        damped = _descend(gtsam.LevenbergMarquardtOptimizer(problem, quick.values, parameters), effort)
    if damped.rose:
        raise GraphError(f"{where} cannot be solved: its error is not finite; look for absurd information")
    return damped.values, quick.iterations + damped.iterations


def problem_of(terms: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """Return the sum of some terms."""
    import gtsam

    problem = gtsam.NonlinearFactorGraph()
    for term in terms:
        problem.add(term)
    return problem


@dataclass(frozen=True, slots=True, eq=False)
class _Descent:
    """State of the descent; ``rose`` if the last step, not taken, increased the error."""

    values: gtsam.Values
    iterations: int
    rose: bool


def _quick_descent(problem: gtsam.NonlinearFactorGraph, start: gtsam.Values, effort: Effort) -> _Descent:
    """Descend by Gauss–Newton."""
    import gtsam

    parameters = gtsam.GaussNewtonParams()
    for solver in ("MULTIFRONTAL_CHOLESKY", "MULTIFRONTAL_QR"):
        parameters.setLinearSolverType(solver)
        with suppress(RuntimeError):  # some step is not determined without damping, or not by this solver
            return _descend(gtsam.GaussNewtonOptimizer(problem, start, parameters), effort)
    return _Descent(start, 0, rose=True)


def _descend(optimizer: Any, effort: Effort) -> _Descent:
    import gtsam

    # The optimizer returns a reference to its values, which its next step overwrites.
    values, error = gtsam.Values(optimizer.values()), optimizer.error()
    for iteration in range(1, effort.max_iterations + 1):
        optimizer.iterate()
        improved = optimizer.error()
        effort.report(iteration, effort.max_iterations)
        if not improved <= error * (1.0 + effort.relative_error) + _ABSOLUTE_ERROR:
            return _Descent(values, iteration, rose=True)
        values, gain, error = gtsam.Values(optimizer.values()), error - improved, improved
        if gain <= max(_ABSOLUTE_ERROR, effort.relative_error * (error + gain)):
            effort.report(iteration, iteration)
            return _Descent(values, iteration, rose=not np.isfinite(error))
    return _Descent(values, effort.max_iterations, rose=False)
