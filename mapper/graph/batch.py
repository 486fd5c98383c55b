"""A least-squares problem in GTSAM's words, and the Levenberg–Marquardt run that solves it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from mapper.errors import GraphError

if TYPE_CHECKING:
    import gtsam

# χ² has no unit: once a step gains less than this, only rounding is left.
_ABSOLUTE_ERROR = 1e-10


@dataclass(frozen=True, slots=True)
class Effort:
    """When to stop: after so many iterations, or when one improves the error by less than this share."""

    max_iterations: int
    relative_error: float


def solve(
    terms: Iterable[gtsam.NonlinearFactor],
    more_terms: Iterable[gtsam.NonlinearFactor],
    start: gtsam.Values,
    *,
    effort: Effort,
) -> tuple[gtsam.Values, int]:
    """Minimise the sum of all terms by Levenberg–Marquardt (Marquardt 1963).

    Returns:
        The solution and the iterations it took.

    Raises:
        GraphError: The solver fails, or its error becomes infinite.
    """
    import gtsam

    problem = gtsam.NonlinearFactorGraph()
    for term in chain(terms, more_terms):
        problem.add(term)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(effort.max_iterations)
    parameters.setRelativeErrorTol(effort.relative_error)
    parameters.setAbsoluteErrorTol(_ABSOLUTE_ERROR)
    where = f"the graph of {start.size()} nodes from node {min(start.keys())}"
    try:
        optimizer = gtsam.LevenbergMarquardtOptimizer(problem, start, parameters)
        solved = optimizer.optimize()
    except RuntimeError as error:  # how GTSAM's C++ exceptions arrive, several lines long
        reason = " ".join(str(error).split())
        raise GraphError(f"{where} cannot be solved: {reason}") from None
    cost = optimizer.error()
    if not np.isfinite(cost):
        raise GraphError(f"{where} cannot be solved: its error became {cost}; look for absurd information")
    return solved, optimizer.iterations()
