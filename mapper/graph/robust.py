"""Loops may be false: Graduated Non-Convexity decides about each, robust kernels weigh each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mapper.config.graph import GraphConfig
from mapper.geometry import Array
from mapper.graph.batch import Effort, Part, solve
from mapper.graph.drift import innovations
from mapper.graph.model import BetweenFactor
from mapper.graph.terms import Kernel, between
from mapper.progress import Report

if TYPE_CHECKING:
    import gtsam

_GROWTH = 1.4
"""Of μ in each round (Yang et al. 2020, remark 5)."""
_MAX_ROUNDS = 100
_ROUND = Effort(max_iterations=3, relative_error=1e-4)
"""A round only prepares the next."""
_DECIDED = 1e-3
"""A weight this close to 0 or 1 has arrived."""
_MEDIAN_CHI2 = 5.348
"""Median of χ² with six degrees of freedom."""
_DRIFT_SLACK = 3.0
"""Systematic drift grows with the way, not with its root, so long loops disagree more than short ones."""


def solve_part(part: Part, config: GraphConfig, *, report: Report) -> tuple[gtsam.Values, Array, int]:
    """Solve a part with its loops in doubt.

    Args:
        part: What to solve.
        config: Which kernel, and when to stop.
        report: Told how far the last descent is.

    Returns:
        The solution, the weight of each loop in [0, 1], and the iterations.

    Raises:
        GraphError: The solver fails.
    """
    effort = Effort(config.max_iterations, config.relative_error, report)
    kernel = None
    match config.robust:
        case "gnc" if part.loops:
            weights, near, prepared = _graduate(part, config.robust_width)
            solved, iterations = solve(part.held, _weighted(part.loops, weights), near, effort=effort)
            return solved, weights, prepared + iterations
        case "cauchy" | "huber" | "dcs" as kind:
            kernel = Kernel(kind, config.robust_width)
    terms = [between(loop, kernel=kernel) for loop in part.loops]
    solved, iterations = solve(part.held, terms, part.start, effort=effort)
    chi2 = _chi2([between(loop) for loop in part.loops], solved)
    return solved, kernel.weights(chi2) if kernel else np.ones_like(chi2), iterations


def _graduate(part: Part, width: float) -> tuple[Array, gtsam.Values, int]:
    """Return a weight of 0 or 1 for each loop, and poses that are nearly solved with them.

    Graduated Non-Convexity with truncated least squares (Yang et al. 2020). Information that counts
    features as independent is over-confident, so the limit is scaled by how far the median loop
    lies from what odometry predicts, where that is farther than honest. Loops that odometry rules out even so
    sit out the first round, in which a cluster of false ones could fold the path beyond recovery.
    """
    terms = [between(loop) for loop in part.loops]
    apart = innovations(part.known, part.loops)
    limit = width**2 * max(1.0, float(np.median(apart)) / _MEDIAN_CHI2)
    weights = (apart <= _DRIFT_SLACK**2 * limit).astype(np.float64)
    poses, iterations = solve(part.held, _weighted(part.loops, weights), part.start, effort=_ROUND)
    chi2 = _chi2(terms, poses)
    worst = chi2[weights > 0.0].max(initial=0.0)
    if worst > limit:
        mu = limit / (2.0 * worst - limit)
        for _ in range(_MAX_ROUNDS):
            weights = _truncated(chi2, limit, mu)
            poses, more = solve(part.held, _weighted(part.loops, weights), poses, effort=_ROUND)
            iterations += more
            chi2 = _chi2(terms, poses)
            if (np.minimum(weights, 1.0 - weights) < _DECIDED).all():
                break
            mu *= _GROWTH
    return (chi2 <= limit).astype(np.float64), poses, iterations


def _truncated(chi2: Array, limit: float, mu: float) -> Array:
    """Return the weights of truncated least squares at one μ (Yang et al. 2020, eq. 14)."""
    ramp: Array = np.sqrt(limit * mu * (mu + 1.0) / np.maximum(chi2, 1e-12)) - mu
    return np.clip(ramp, 0.0, 1.0)


def _weighted(loops: Sequence[BetweenFactor], weights: Array) -> list[gtsam.NonlinearFactor]:
    pairs = zip(loops, weights, strict=True)
    return [between(loop, weight=float(weight)) for loop, weight in pairs if weight > 0.0]


def _chi2(terms: Sequence[gtsam.NonlinearFactor], poses: gtsam.Values) -> Array:
    return np.array([2.0 * term.error(poses) for term in terms])
