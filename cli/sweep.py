"""``mapper sweep``: many logs, methods and configurations."""

import os
from pathlib import Path
from typing import Annotated

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.console import files_text
from mapper.cli.environment import note_compilation
from mapper.cli.options import workers_for


def sweep(
    file: Annotated[
        Path,
        typer.Argument(metavar="SWEEP.toml", help="Names the logs, the methods and the configurations."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the results; what is finished there is not run again.  [default: sweeps/SWEEP]"
        ),
    ] = None,
    processes: Annotated[
        int | None, typer.Option(help="Builds at a time, one core each; omit for one on every core.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="tcp://HOST:PORT", help="Build on the workers of this Dask scheduler instead."),
    ] = None,
    *,
    output: Output,
) -> Answer:
    """Build every log with every method in every configuration, and compare the results.

    If a sweep was interrupted or killed, the same command resumes it, and retries what failed.

    Example: mapper sweep sweep.toml --out sweeps/first --processes 4
    """
    from mapper.evaluators.sweep.files import FILES, write_sweep
    from mapper.evaluators.sweep.plan import plan_sweep, run_sweep
    from mapper.evaluators.sweep.tables import summary_text

    workers = workers_for(processes, scheduler, default=os.cpu_count() or 1)
    progress = output.progress()
    out = out or Path("sweeps") / file.stem
    plan = plan_sweep(file, out)
    note_compilation(progress)
    results = run_sweep(
        plan,
        workers=workers,
        progress=progress,
    )
    records = write_sweep(plan, results, title=file.stem)
    return Answer({"path": out, "builds": records}, f"{summary_text(records)}\n{files_text(out, FILES)}")
