"""``mapper view``: a finished run in Rerun."""

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from cli.answer import Answer, Output, made
from cli.options import RunFolder


def view(
    run: RunFolder,
    rrd: Annotated[
        Path | None, typer.Option(help="File to write; omit all three to keep it in RUN as run.rrd.")
    ] = None,
    spawn: Annotated[bool, typer.Option("--spawn", help="Open a viewer and show the run there.")] = False,
    connect: Annotated[
        str | None,
        typer.Option(metavar="URL", help="Show the run in a viewer that runs: rerun+http://HOST:9876/proxy."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the --rrd file.")] = False,
    *,
    output: Output,  # noqa: ARG001
) -> Answer:
    """Show a finished run in Rerun: paths, graph, loops, voxels, cloud, slice, images and diagnostics.

    Example: mapper view runs/xyz --spawn, or: mapper view runs/xyz --rrd xyz.rrd
    """
    from mapper.core.errors import ConfigError, RunError
    from mapper.export.rerun.finished import show_run
    from mapper.run.files import RERUN
    from mapper.run.folder import open_run

    if (rrd is not None) + spawn + (connect is not None) > 1:
        raise ConfigError("--rrd, --spawn and --connect: choose one")
    if rrd is not None and rrd.exists() and not overwrite:
        raise RunError(f"{rrd}: exists already; choose another --rrd, or pass --overwrite to replace it")
    built = open_run(run)
    if spawn or connect is not None:
        show_run(built, "spawn" if connect is None else f"connect:{connect}")
        return Answer({"run": built.path})
    path = rrd or built.path / RERUN
    with nullcontext() if rrd else built.changing({RERUN}):
        show_run(built, str(path))
    return made(path)
