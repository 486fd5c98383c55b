"""``mapper compare``, ``sweep`` and ``reproduce``: tables of methods, logs and settings, one job a cell."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from mapper.cli.answer import Answer, Output, record_in
from mapper.cli.console import files_text
from mapper.cli.options import (
    First,
    Last,
    Overrides,
    Overwrite,
    Stride,
    selection,
    settings_of,
    workers_for,
)
from mapper.core.errors import ConfigError
from mapper.runtime.kernels import note_compilation


def compare(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Recorded log that mapper build can read.")],
    method: Annotated[
        list[str] | None,
        typer.Option("--method", help="Method to compare; repeatable. Omit for all that fit the log."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder to create.")] = Path("compare"),
    pairs: Annotated[
        int | None, typer.Option(help="Pairs of frames to register; 0 for odometry alone.  [default: 30]")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the guesses' errors.")] = None,
    first: First = None,
    last: Last = None,
    stride: Stride = None,
    set_: Overrides = None,
    overwrite: Overwrite = False,
    *,
    output: Output,
) -> Answer:
    """Run every method over the same frames, as odometry and on pairs of frames with wrong guesses.

    If a comparison was stopped, the same command resumes it after the last finished method.

    Example: mapper compare rgbd_dataset_freiburg1_xyz --method isvd --method gicp --out runs/compared
    """
    from mapper.evaluators.compare.files import REPORT, tables_text
    from mapper.evaluators.compare.files import compare as compare_methods

    short_options = {**selection(first, last, stride, None), "pairs": pairs, "seed": seed}
    comparison = compare_methods(
        log,
        methods=method or (),
        out=out,
        settings=settings_of(short_options, set_),
        overwrite=overwrite,
        progress=output.progress(),
    )
    return Answer(record_in(out, REPORT), f"{tables_text(comparison)}\n{files_text(out)}")


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
    from mapper.evaluators.sweep.page import FILES, write_sweep
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


def reproduce(
    paper: Annotated[
        Literal["thesis", "zhao", "hough"], typer.Argument(metavar="PAPER", help="thesis, zhao or hough.")
    ],
    logs: Annotated[Path, typer.Option(help="Folder with the paper's logs, under their usual names.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for tables and pictures; resumed if it exists.  [default: PAPER]"),
    ] = None,
    log: Annotated[
        list[str] | None,
        typer.Option("--log", metavar="NAME=PATH", help="Path of a log that has another name: fr1/xyz=PATH."),
    ] = None,
    tables: Annotated[
        str | None,
        typer.Option(
            help="Only these, e.g. 5.1,5.2; thesis has detectors, too. Another choice is measured again."
        ),
    ] = None,
    seeds: Annotated[
        int, typer.Option(help="Draws of everything random; median and spread are over them.")
    ] = 3,
    first: First = None,
    last: Last = None,
    processes: Annotated[
        int | None,
        typer.Option(
            help="Measurements at a time; omit for one on every core, of zhao and hough one: they are timed."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="tcp://HOST:PORT", help="Let the workers of this Dask scheduler measure."),
    ] = None,
    *,
    output: Output,
) -> Answer:
    """Measure a paper's tables again on the logs available, and print our figures beside theirs.

    Finished results are kept in OUT, so if killed, the same command resumes.

    Example: mapper reproduce thesis --logs logs --tables 5.1,5.2 --out runs/thesis
    """
    from mapper.evaluators.papers.files import tables_text
    from mapper.evaluators.papers.model import everything
    from mapper.evaluators.papers.paper import Cut
    from mapper.evaluators.papers.reproduce import Request
    from mapper.evaluators.papers.reproduce import reproduce as reproduce_tables

    every_core = os.cpu_count() or 1
    workers = workers_for(processes, scheduler, default=every_core if paper == "thesis" else 1)
    request = Request(
        paper=paper,
        logs=logs,
        given=_given(log or ()),
        tables=tuple(filter(None, (tables or "").replace(" ", "").split(","))),
        seeds=seeds,
        cut=Cut(first or 0, last),
    )
    progress = output.progress()
    note_compilation(progress)
    out = out or Path(paper)
    reproduction = reproduce_tables(
        request,
        out,
        workers=workers,
        progress=progress,
    )
    document = {"path": out, "missing": reproduction.missing, "cells": everything(reproduction)}
    return Answer(document, f"{tables_text(reproduction)}\n{files_text(out)}")


def _given(assignments: Sequence[str]) -> dict[str, Path]:
    """Return the logs of other names.

    Raises:
        ConfigError: One is no ``NAME=PATH``, or two have the same name.
    """
    given: dict[str, Path] = {}
    for assignment in assignments:
        name, equals, path = assignment.partition("=")
        if not (name and equals and path):
            raise ConfigError(
                f"--log {assignment}: want NAME=PATH, for example fr1/xyz={assignment or 'PATH'}"
            )
        if name in given:
            raise ConfigError(f"--log {assignment}: {name} is {given[name]} already; give one of them")
        given[name] = Path(path)
    return given
