"""``mapper reproduce``: the papers' tables measured again, our figures beside theirs."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.console import files_text
from mapper.cli.environment import note_compilation
from mapper.cli.options import First, Last, workers_for
from mapper.core.errors import ConfigError


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
    from mapper.evaluators.papers.layout import everything
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
