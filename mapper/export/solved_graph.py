"""Products of ``mapper solve``: the solved graph alone, or a folder with its path, a picture and a report."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mapper.core.errors import GraphError, RunError
from mapper.core.geometry import Array
from mapper.core.trajectory import trajectory_from
from mapper.export.figures import ESTIMATE, FACTORS, FAINT, TEXT, hex_of, new_figure, save
from mapper.graph.components import components
from mapper.graph.config import GraphConfig
from mapper.graph.g2o import write_g2o
from mapper.graph.model import PoseGraph, Solution
from mapper.loops.closure import MIN_WEIGHT
from mapper.runtime.atomic import FolderKind, atomic_folder, write_json
from mapper.sources.trajectory_files import write_tum

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_POSE_FREEDOM = 6
_MOST_CHI2 = 10.0
"""For each degree of freedom: seven published graphs have at most 1.04, one with false loops 2.4 where GNC
left these out, and 270 where it kept some."""
GRAPH, KEYFRAMES, PICTURE, REPORT = "graph.g2o", "keyframes.tum", "graph.png", "solve.json"
_FOLDER = FolderKind(
    "a solved graph", manifest_keys=frozenset(), files=frozenset({GRAPH, KEYFRAMES, PICTURE, REPORT})
)


@dataclass(frozen=True, slots=True, eq=False)
class SolvedGraph:
    """A graph, its solution, and the effort of the solver.

    Attributes:
        path: The file that the graph came from.
        graph: Nodes at their first estimates.
        solution: Solution of that graph.
        config: Settings of the solver.
        seconds: Durations of reading and solving, by name.
    """

    path: Path
    graph: PoseGraph
    solution: Solution
    config: GraphConfig
    seconds: dict[str, float]

    @property
    def solved(self) -> PoseGraph:
        """The graph with its nodes at the solution, and all of its factors."""
        return self.graph.with_poses(self.solution.T_world_node)

    @property
    def component_sizes(self) -> list[int]:
        """Nodes of every connected component, in the graph's order."""
        return [len(nodes) for nodes in components(self.graph)]

    @property
    def loops(self) -> int:
        """Number of factors that are loops."""
        return len(self.graph.loops)

    @property
    def rejected(self) -> list[tuple[int, int]]:
        """Nodes i, j of every loop that the solver rejected."""
        return [(self.graph.factors[k].i, self.graph.factors[k].j) for k in self.rejected_factors]

    @property
    def rejected_factors(self) -> list[int]:
        """Indices of the factors that the solver rejected."""
        return [k for k, weight in enumerate(self.solution.weights) if weight < MIN_WEIGHT]

    @property
    def chi2_per_freedom(self) -> float:
        """χ² of the kept factors for each degree of freedom: about 1 if their information is right.

        0 where nothing is redundant.
        """
        spanning = len(self.graph.T_world_node) - len(self.component_sizes)
        freedom = _POSE_FREEDOM * (len(self.graph.factors) - len(self.rejected_factors) - spanning)
        return 2.0 * self.solution.error_after / freedom if freedom > 0 else 0.0

    @property
    def contradiction(self) -> str:
        """In words that the factors that were kept contradict each other; empty if they do not."""
        if self.chi2_per_freedom <= _MOST_CHI2:
            return ""
        return (
            "the edges that are kept contradict each other: their squared errors are "
            f"{self.chi2_per_freedom:.0f} times what their information says, want at most {_MOST_CHI2:.0f}; "
            "one is wrong (--robust gnc leaves wrong loops out), odometry is missing, or the information too "
            "large"
        )


def write_solved_graph(out: Path, solved: SolvedGraph) -> None:
    """Write the solved graph to a new ``.g2o`` file, or to a new folder with everything else.

    Raises:
        RunError: The file or folder exists already, or cannot be made.
        GraphError: The rejected loops were all that connected some nodes.
    """
    refuse_existing_result(out)
    rejected = frozenset(solved.rejected_factors)
    held = [factor for k, factor in enumerate(solved.graph.factors) if k not in rejected]
    parts, given_parts = len(components(solved.graph.with_factors(held))), len(solved.component_sizes)
    if parts > given_parts:
        raise GraphError(
            f"{solved.path}: without its {len(rejected)} rejected loops the graph falls apart into {parts} "
            f"components, not {given_parts}, so the solution holds for none; --robust none keeps every edge, "
            f"or number the vertices in the order of the odometry"
        )
    if out.suffix == ".g2o":
        write_g2o(out, solved.solved, rejected=rejected)
        return
    with atomic_folder(out, _FOLDER) as folder:
        write_g2o(folder / GRAPH, solved.solved, rejected=rejected)
        by_time = sorted((stamp, node) for node, stamp in solved.graph.stamps_ns.items())
        poses = ((stamp, solved.solution.T_world_node[node]) for stamp, node in by_time)
        write_tum(folder / KEYFRAMES, trajectory_from(poses))
        write_graph_views(folder / PICTURE, solved.graph, solved.solution, title=solved.path.name)
        write_json(folder / REPORT, solve_report(solved))


def refuse_existing_result(out: Path) -> None:
    """Refuse to write where something is already, such as the graph that is to be solved.

    Raises:
        RunError: It is there.
    """
    if out.exists():
        raise RunError(f"{out}: exists already; choose another --out")


def solve_report(solved: SolvedGraph) -> dict[str, object]:
    """Return what ``solve.json`` holds."""
    return {
        "graph": str(solved.path.resolve()),
        "config": solved.config.model_dump(),
        "nodes": len(solved.graph.T_world_node),
        "edges": len(solved.graph.factors),
        "loops": solved.loops,
        "rejected": solved.rejected,
        "component_sizes": solved.component_sizes,
        "error_before": solved.solution.error_before,
        "error_after": solved.solution.error_after,
        "chi2_per_freedom": solved.chi2_per_freedom,
        "iterations": solved.solution.iterations,
        "seconds": {name: round(seconds, 3) for name, seconds in solved.seconds.items()},
    }


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
    figure.text(0.03, 0.955, title, fontsize=14, fontweight="bold", color=TEXT)
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
    from matplotlib.collections import LineCollection

    index = {node: k for k, node in enumerate(graph.T_world_node)}
    ends = np.array([(index[factor.i], index[factor.j]) for factor in graph.factors], np.int64).reshape(-1, 2)
    origins = np.array([factor.origin for factor in graph.factors])
    accepted = np.array(solution.weights) >= MIN_WEIGHT
    for origin, color in FACTORS.items():
        for drawn, style in ((accepted, "solid"), (~accepted, "dotted")):
            lines = seen[ends[drawn & (origins == origin)]]
            axes.add_collection(LineCollection(lines, colors=hex_of(color), linewidths=0.8, linestyles=style))
