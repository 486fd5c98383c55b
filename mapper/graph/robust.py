"""Robust solving of one component: graduated non-convexity or a robust kernel on its loops."""

import numpy as np

from mapper.graph.batch import Effort, Part, PartSolution, solve
from mapper.graph.config import GraphConfig
from mapper.graph.graduated_non_convexity import chi2_of, graduate, weighted
from mapper.graph.terms import Kernel, between
from mapper.runtime.progress import Report


def solve_part(part: Part, config: GraphConfig, *, report: Report) -> PartSolution:
    """Solve a component with outlier rejection of its loops.

    Args:
        part: The component.
        config: Kernel and termination criteria.
        report: Receives the iterations of the last solve.

    Raises:
        GraphError: The solver fails.
    """
    effort = Effort(config.max_iterations, config.relative_error, report)
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
