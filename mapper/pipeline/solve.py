"""Solving a tracked graph: the solution, the final verdict of every loop, and the manifest's record."""

from collections.abc import Sequence
from dataclasses import dataclass

from mapper.graph.components import align_components, components
from mapper.graph.config import GraphConfig
from mapper.graph.model import PoseGraph, Solution
from mapper.graph.optimize import optimize
from mapper.loops.closure import LoopClosure, apply_solution
from mapper.run.manifest import Solve

MIN_WEIGHT = 0.5
"""A loop with less weight in the solution is rejected, and is no factor of the solved graph."""


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
        graph: With a factor for each accepted loop, after all the others and in the loops' order.
        loops: Every candidate.
        config: Which solve.

    Raises:
        GraphError: The graph cannot be solved.
    """
    graph = align_components(graph)
    solution = optimize(graph, config)
    loops = apply_solution(loops, graph.T_world_node, solution, min_weight=MIN_WEIGHT)
    others = [factor for factor in graph.factors if factor.origin != "loop"]
    held = [loop.factor for loop in loops if loop.verdict == "accepted"]
    return Solved(
        PoseGraph(solution.T_world_node, graph.stamps_ns, [*others, *held]),
        loops,
        _report(solution, graph),
    )


def _report(solution: Solution, graph: PoseGraph) -> Solve:
    return Solve(
        error_before=solution.error_before,
        error_after=solution.error_after,
        iterations=solution.iterations,
        components=len(components(graph)),
    )
