"""``mapper view``: a run in Rerun, or runs as one page with the map in 3D; ``mapper report``: their page."""

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from mapper.cli.answer import Answer, Output, made
from mapper.cli.options import Overwrite, RunFolders, refuse_several, refuse_without
from mapper.core.errors import ConfigError
from mapper.runtime.atomic import refuse_existing


def view(
    runs: RunFolders,
    html: Annotated[
        bool, typer.Option("--html", help="Write one page with the map in 3D, for any browser, offline.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="With --html: the file; omit for RUN.html here.")] = None,
    rrd: Annotated[
        Path | None, typer.Option(help="File to write; omit all three to keep it in RUN as run.rrd.")
    ] = None,
    spawn: Annotated[bool, typer.Option("--spawn", help="Open a viewer and show the run there.")] = False,
    connect: Annotated[
        str | None,
        typer.Option(metavar="URL", help="Show the run in a running viewer: rerun+http://HOST:9876/proxy."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the --rrd file or OUT.")] = False,
    *,
    output: Output,
) -> Answer:
    """Show a finished run in Rerun or in a browser: path, graph, loops, voxels, cloud, slice, images.

    A merged map is shown in a browser (--html): its voxels, its runs' paths, and the loops between them.

    Example: mapper view runs/xyz --spawn, or: mapper view runs/xyz --html
    """
    from mapper.api.runs import write_page
    from mapper.run.files import RERUN
    from mapper.run.folder import open_run

    refuse_several({"--rrd": rrd, "--spawn": spawn, "--connect": connect, "--html": html})
    if html:
        return made(write_page(runs, out, overwrite=overwrite))
    refuse_without("--html", {"--out": out})
    if len(runs) > 1:
        raise ConfigError(f"{len(runs)} runs: Rerun shows one; --html shows several")
    (run,) = runs
    if rrd is not None:
        refuse_existing(rrd, overwrite=overwrite, option="--rrd")
    built = open_run(run)
    from mapper.export.rerun.finished import show_run  # needs Rerun, which the page does not

    if spawn or connect is not None:
        show_run(built, "spawn" if connect is None else f"connect:{connect}")
        return Answer({"run": built.path})
    path = rrd or built.path / RERUN
    with nullcontext() if rrd else built.changing({RERUN}), output.waiting("view"):
        show_run(built, str(path))
    return made(path)


def report(
    runs: RunFolders,
    out: Annotated[
        Path | None, typer.Option(help="HTML file to write.  [default: report.html, or with a number]")
    ] = None,
    overwrite: Overwrite = False,
    *,
    output: Output,
) -> Answer:
    """Write one self-contained page about a run, or about several side by side; it opens offline.

    Example: mapper report runs/xyz runs/xyz-isvd --out report.html
    """
    from mapper.evaluators.pictures.run_report import report as report_on
    from mapper.run.folder import open_run

    loaded = [open_run(run) for run in runs]
    with output.waiting("report"):
        return made(report_on(loaded, out, overwrite=overwrite))
