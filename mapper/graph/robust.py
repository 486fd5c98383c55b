"""Robust solving of one component, by a kernel on its loops or graduated non-convexity (Yang et al. 2020)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapper.core.clusters import cluster_numbers
from mapper.core.geometry import Array
from mapper.graph.config import GraphConfig
from mapper.graph.drift import MOST_TRIED, innovations
from mapper.graph.gtsam_factors import Kernel, between
from mapper.graph.least_squares import Effort, Part, PartSolution, solve
from mapper.graph.measurement_covariance import MEDIAN_CHI2
from mapper.graph.model import BetweenFactor
from mapper.runtime.progress import Report

if TYPE_CHECKING:
    import gtsam

_GROWTH = 1.4
"""Factor by which μ grows in each round (Yang et al. 2020, remark 5)."""
_MAX_ROUNDS = 100
ROUND = Effort(max_iterations=3, relative_error=1e-4)
"""Solver effort of a round: its result is only the start of the next."""
_DECIDED = 1e-3
"""A weight this close to 0 or 1 has converged."""
_DRIFT_SLACK = 3.0
"""Systematic drift grows with the path, not its square root: long loops disagree more than short ones."""
_UNUSED_LOOP_RATIO = 4.0
"""Factor on the limit of an unused loop: the path has not been optimised with it."""
_CLUSTER_NODES = 10
"""Loops whose ends are at most this far apart, in nodes by order of id, form a cluster, tried as one."""


@dataclass(frozen=True, slots=True, eq=False)
class Graduated:
    """State after a round.

    Attributes:
        poses: Poses nearly optimal for the loops weighted in it.
        chi2: (L,) squared residual of every loop at these poses, in sigmas.
        iterations: Solver iterations so far.
    """

    poses: gtsam.Values
    chi2: Array
    iterations: int


def graduate(part: Part, width: float) -> tuple[Array, Graduated]:
    """Return a weight of 0 or 1 for each loop of a component, and the state with these weights.

    Truncated least squares. Information that treats features as independent is over-confident, so the
    limit is scaled by the distance of the median loop from the odometry's prediction where that exceeds the
    χ² median. Loops beyond the scaled limit take no part in the first round, in which a cluster of
    false ones could deform the path beyond recovery.

    Args:
        part: Component with at least one loop.
        width: Residual in sigmas beyond which a loop with consistent information is an outlier.

    Raises:
        GraphError: The solver fails.
    """
    apart = innovations(part.known, part.loops)
    limit = width**2 * max(1.0, float(np.median(apart)) / MEDIAN_CHI2)
    terms = [between(loop) for loop in part.loops]
    weights = (apart <= _DRIFT_SLACK**2 * limit).astype(np.float64)
    now = _round(part, terms, weights, Graduated(part.start, apart, 0))
    worst = now.chi2[weights > 0.0].max(initial=0.0)
    now = truncate(partial(_round, part, terms), now, worst=worst, limit=limit)
    now = _refine_inliers(part, terms, now, apart=apart, limit=limit)
    return (now.chi2 <= limit).astype(np.float64), now


def weighted(loops: Sequence[BetweenFactor], weights: Array) -> list[gtsam.NonlinearFactor]:
    """Return the terms of the loops that have any weight."""
    pairs = zip(loops, weights, strict=True)
    return [between(loop, weight=float(weight)) for loop, weight in pairs if weight > 0.0]


def chi2_of(terms: Sequence[gtsam.NonlinearFactor], poses: gtsam.Values) -> Array:
    """Return the squared residual of each term, in sigmas."""
    return np.array([2.0 * term.error(poses) for term in terms])


def _round(
    part: Part, terms: Sequence[gtsam.NonlinearFactor], weights: Array, before: Graduated
) -> Graduated:
    poses, more = solve(part.held, weighted(part.loops, weights), before.poses, effort=ROUND)
    return Graduated(poses, chi2_of(terms, poses), before.iterations + more)


def truncate(
    step: Callable[[Array, Graduated], Graduated], now: Graduated, *, worst: float, limit: float
) -> Graduated:
    """Return the state in which truncated least squares has decided on every measurement.

    Args:
        step: Returns the state after a round with some weights, from the state before.
        now: State with all measurements that take part at first.
        worst: Largest χ² of these.
        limit: χ² beyond which a measurement is an outlier.
    """
    if worst > limit:
        mu = limit / (2.0 * worst - limit)
        for _ in range(_MAX_ROUNDS):
            weights = _truncated(now.chi2, limit, mu)
            now = step(weights, now)
            if (np.minimum(weights, 1.0 - weights) < _DECIDED).all():
                break
            mu *= _GROWTH
    return now


def _truncated(chi2: Array, limit: float, mu: float) -> Array:
    """Return the weights of truncated least squares at one μ (Yang et al. 2020, eq. 14)."""
    ramp: Array = np.sqrt(limit * mu * (mu + 1.0) / np.maximum(chi2, 1e-12)) - mu
    return np.clip(ramp, 0.0, 1.0)


def _refine_inliers(
    part: Part, terms: Sequence[gtsam.NonlinearFactor], now: Graduated, *, apart: Array, limit: float
) -> Graduated:
    """Change the set of inliers where that lowers the truncated cost, while any loop is rejected.

    A true loop may stay rejected because the path was never optimised with it: loops near the limit are
    added. False loops that agree with each other can outweigh the true ones, if these are fewer: clusters are
    removed, first those farthest from the odometry's prediction.
    """
    clusters = sorted(_clusters(part), key=lambda cluster: -float(apart[cluster].max()))
    cost = _cost(part, now, limit)
    for cluster in (None, *clusters[:MOST_TRIED]):
        inliers = now.chi2 <= limit
        tried = now.chi2 <= _UNUSED_LOOP_RATIO * limit if cluster is None else inliers & ~cluster
        if inliers.all() or (tried == inliers).all():
            continue
        then = _round(part, terms, tried.astype(np.float64), now)
        for share in (_UNUSED_LOOP_RATIO, 1.0):
            then = _round(part, terms, (then.chi2 <= share * limit).astype(np.float64), then)
        if (lower := _cost(part, then, limit)) < cost:
            now, cost = then, lower
    return now


def _cost(part: Part, now: Graduated, limit: float) -> float:
    """Return the truncated least-squares cost."""
    return 2.0 * sum(term.error(now.poses) for term in part.held) + float(np.minimum(now.chi2, limit).sum())


def _clusters(part: Part) -> list[NDArray[np.bool_]]:
    """Return clusters of loops as masks: loops are connected where both ends are close."""
    place = {node: k for k, node in enumerate(part.start.keys())}
    ends = np.sort([(place[loop.i], place[loop.j]) for loop in part.loops], axis=1)
    numbers = cluster_numbers(ends, _CLUSTER_NODES, norm=np.inf)
    return [numbers == number for number in range(numbers.max() + 1)]


def solve_part(part: Part, config: GraphConfig, *, report: Report) -> PartSolution:
    """Solve a component with outlier rejection of its loops.

    Args:
        part: The component.
        config: Kernel and termination criteria.
        report: Receives the iterations of the last solve.

    Raises:
        GraphError: The solver fails.
    """
    effort = Effort(config.max_iterations, report=report)
    kernel = None
    match config.robust:
        case "gnc" if part.loops:
            weights, near = graduate(part, config.robust_width)
            inliers = weighted(part.loops, weights)
            poses, iterations = solve(part.held, inliers, near.poses, effort=effort)
            return PartSolution(poses, weights, near.iterations + iterations)
        case "cauchy" | "huber" | "dcs" as kind:
            kernel = Kernel(kind, config.robust_width)
    terms = [between(loop, kernel=kernel) for loop in part.loops]
    poses, iterations = solve(part.held, terms, part.start, effort=effort)
    chi2 = chi2_of([between(loop) for loop in part.loops], poses)
    return PartSolution(poses, kernel.weights(chi2) if kernel else np.ones_like(chi2), iterations)
