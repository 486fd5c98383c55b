"""``mapper report``: runs as one HTML page."""

from pathlib import Path
from typing import Annotated

import typer

from mapper.cli.answer import Answer, Output, made
from mapper.cli.options import Overwrite, RunFolders


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
