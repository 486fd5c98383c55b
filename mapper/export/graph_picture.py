"""Picture of a pose graph before and after it was solved."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mapper.core.geometry import Array
from mapper.export.page import FAINT, INK, hex_of, new_figure, save
from mapper.export.palette import ESTIMATE, FACTORS
from mapper.graph.model import PoseGraph, Solution
from mapper.loops.closure import MIN_WEIGHT

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def write_graph_views(path: Path, graph: PoseGraph, solution: Solution, *, title: str) -> None:
    """Draw a pose graph before and after it was solved, from the side on which it is widest.

    Args:
        path: PNG file to write.
        graph: Nodes at their first estimates.
        solution: Solution of that graph; factors that it rejected are drawn dotted.
        title: Headline.
    """
    solved = np.array(list(solution.T_world_node.values()))[:, :3, 3]
    *_, axes_world = np.linalg.svd(solved - solved.mean(axis=0), full_matrices=False)
    figure = new_figure(13.0, 6.9)
    figure.text(0.03, 0.955, title, fontsize=14, fontweight="bold", color=INK)
    states = (
        ("before", graph.T_world_node, solution.error_before),
        ("after", solution.T_world_node, solution.error_after),
    )
    for column, (name, T_world_node, cost) in enumerate(states):
        seen = np.array(list(T_world_node.values()))[:, :3, 3] @ axes_world[:2].T
        axes = figure.add_axes((0.02 + 0.49 * column, 0.02, 0.47, 0.86))
        _draw_factors(axes, seen, graph, solution)
        axes.plot(*seen.T, ".", color=hex_of(ESTIMATE), markersize=1.5)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_title(f"{name}: cost {cost:.6g}", color=FAINT, fontsize=11)
        axes.set_axis_off()
    save(figure, path)


def _draw_factors(axes: "Axes", seen: Array, graph: PoseGraph, solution: Solution) -> None:
    """Draw the factors between the (N, 2) places of the graph's nodes."""
    from matplotlib.collections import LineCollection

    index = {node: k for k, node in enumerate(graph.T_world_node)}
    ends = np.array([(index[factor.i], index[factor.j]) for factor in graph.factors], np.int64).reshape(-1, 2)
    origins = np.array([factor.origin for factor in graph.factors])
    accepted = np.array(solution.weights) >= MIN_WEIGHT
    for origin, color in FACTORS.items():
        for drawn, style in ((accepted, "solid"), (~accepted, "dotted")):
            lines = seen[ends[drawn & (origins == origin)]]
            axes.add_collection(LineCollection(lines, colors=hex_of(color), linewidths=0.8, linestyles=style))
