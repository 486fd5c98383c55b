"""``mapper solve``: a pose graph from g2o text, solved."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mapper.cli.answer import Answer, Output, rows_text
from mapper.cli.options import Overrides, settings_of
from mapper.core.errors import listed
from mapper.runtime.result_paths import RUNS, name_of, place_of

if TYPE_CHECKING:
    from mapper.export.solved_graph import SolvedGraph


def solve(
    graph: Annotated[Path, typer.Argument(metavar="GRAPH.g2o", help="Pose graph in 3D or 2D.")],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.g2o|FOLDER", help="File to write, or folder to create.  [default: runs/GRAPH]"
        ),
    ] = None,
    robust: Annotated[
        Literal["gnc", "cauchy", "huber", "dcs", "none"] | None,
        typer.Option(
            help="Outlier rejection of loops; in other programs' files, edges between non-consecutive ids."
        ),
    ] = None,
    initial: Annotated[
        Literal["auto", "given", "chordal"] | None, typer.Option(help="Initial poses.  [default: auto]")
    ] = None,
    set_: Overrides = None,
    *,
    output: Output,
) -> Answer:
    """Solve a pose graph, each connected component separately, and print its cost before and after.

    Example: mapper solve sphere2500.g2o --out solved, or: mapper solve city.g2o --out city2.g2o --robust dcs
    """
    import time

    from mapper.config.loading import overridden
    from mapper.export.solved_graph import (
        SolvedGraph,
        refuse_existing_result,
        solve_report,
        write_solved_graph,
    )
    from mapper.graph.config import GraphConfig
    from mapper.graph.g2o import read_g2o
    from mapper.graph.optimize import optimize

    given = settings_of({"robust": robust, "initial": initial}, set_)
    settings = {name.removeprefix("graph."): value for name, value in given.items()}
    config = overridden(GraphConfig(), settings=settings)
    guess_loops = config.robust != "none" and "robust" in settings
    out = place_of(out, RUNS / name_of(graph))
    refuse_existing_result(out)
    progress = output.progress()
    began = time.perf_counter()
    unsolved = read_g2o(graph, guess_loops=guess_loops, progress=progress)
    read = time.perf_counter()
    solution = optimize(unsolved, config, progress=progress)
    seconds = {"read": read - began, "solve": time.perf_counter() - read}
    solved = SolvedGraph(graph, unsolved, solution, config, seconds)
    write_solved_graph(out, solved)
    if solved.contradiction:
        progress.note(solved.contradiction)
    return Answer({"path": out, **solve_report(solved)}, f"{_table(solved)}\n{out}")


def _table(solved: "SolvedGraph") -> str:
    solution = solved.solution
    rows = [
        ("nodes", str(len(solved.graph.T_world_node))),
        ("edges", str(len(solved.graph.factors))),
        ("components", _sizes_text(solved.component_sizes)),
        ("cost", f"{solution.error_before:.8g} → {solution.error_after:.8g}"),
        ("iterations", str(solution.iterations)),
        ("seconds", ", ".join(f"{name} {seconds:.1f}" for name, seconds in solved.seconds.items())),
    ]
    if solved.loops:
        rows.insert(2, ("loops", f"{solved.loops - len(solved.rejected)} of {solved.loops} accepted"))
    return rows_text(rows)


def _sizes_text(sizes: list[int]) -> str:
    if len(sizes) == 1:
        return "1"
    return f"{len(sizes)}, each solved on its own: {listed(list(map(str, sizes)))} nodes"
