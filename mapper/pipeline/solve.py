"""Solving a tracked graph: the solution, the final verdict of every loop, and the manifest's record."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Transform
from mapper.graph.components import align_components, components
from mapper.graph.config import GraphConfig
from mapper.graph.drift import innovations
from mapper.graph.model import PoseGraph, Solution
from mapper.graph.optimize import optimize
from mapper.loops.closure import LoopClosure, accepted_loops, apply_solution
from mapper.run.manifest import Solve

_ROUNDING = 1e-12
"""Largest change of an element of a pose, metres or none, that is rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A graph at its solution.

    Attributes:
        graph: Nodes as solved, with the factors that hold.
        loops: Every loop candidate with its final verdict.
        report: Record of the solve for the manifest.
    """

    graph: PoseGraph
    loops: tuple[LoopClosure, ...]
    report: Solve


def solve(graph: PoseGraph, loops: Sequence[LoopClosure], config: GraphConfig) -> Solved:
    """Return the graph at its solution, without the loops that the solver rejected.

    Args:
        graph: Graph with a factor for each accepted loop, after all the others and in the loops' order.
        loops: All loop candidates.
        config: Settings of the solver.

    Raises:
        GraphError: The graph cannot be solved.
    """
    graph = align_components(graph)
    solution = optimize(graph, config)
    loops = apply_solution(loops, graph.T_world_node, solution)
    others, held = graph.without_loops().factors, accepted_loops(loops)
    factors = [loop.factor for loop in held]
    report = Solve(
        error_before=solution.error_before,
        error_after=solution.error_after,
        iterations=solution.iterations,
        components=len(components(graph)),
    )
    if tried := len(graph.factors) - len(others):
        report = report.model_copy(update={"loops_rejected": 1.0 - len(held) / tried})
    if held:
        before = [loop.before for loop in held if loop.before is not None]
        report = report.model_copy(
            update={
                "loop_residual_m": float(np.median([miss.translation_m for miss in before])),
                "loop_residual_rad": float(np.median([miss.rotation_rad for miss in before])),
                "loop_residual_sigma": float(np.median(np.sqrt(innovations(others, factors)))),
            }
        )
    graph = graph.with_poses(_moved(graph, solution)).with_loops(factors)
    return Solved(graph, loops, report)


def _moved(graph: PoseGraph, solution: Solution) -> dict[int, Transform]:
    """Return the solved poses; those that only rounding moved stay, and what was made at them holds."""
    return {
        node: T if np.allclose(T, after, rtol=0.0, atol=_ROUNDING) else after
        for (node, T), after in zip(graph.T_world_node.items(), solution.T_world_node.values(), strict=True)
    }
