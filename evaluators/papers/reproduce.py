"""A paper's tables measured again on those of its logs that are at hand; stopped work is resumed."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from mapper.core.errors import ConfigError, DataError
from mapper.evaluators.papers import thesis, zhao
from mapper.evaluators.papers.files import write_reproduction
from mapper.evaluators.papers.hough import hough_jobs, hough_reproduction
from mapper.evaluators.papers.model import Reproduction
from mapper.evaluators.papers.paper import Cut, Found, Paper, find_sequences, job_for
from mapper.evaluators.study.engine import CELLS, run_study
from mapper.runtime.atomic import resumable_folder, write_json
from mapper.runtime.executor import IN_PROCESS, Workers
from mapper.runtime.progress import SILENT, Progress
from mapper.runtime.resumable_jobs import Job, JobResult

PaperName = Literal["thesis", "zhao", "hough"]

PATHS, PICTURES, PLAN = "trajectories", "pictures", "reproduce.json"
_PAPERS: Mapping[PaperName, Paper] = {"thesis": thesis.PAPER, "zhao": zhao.PAPER}


@dataclass(frozen=True, slots=True)
class Request:
    """Request to measure a paper's tables again.

    Attributes:
        paper: The paper.
        logs: Folder in which to look for its logs.
        given: Logs of other names, by the paper's names.
        tables: Names of the tables, e.g. "5.1"; empty is all.
        seeds: Number of draws of all that is random.
        cut: Frames that are used.
    """

    paper: PaperName
    logs: Path
    given: Mapping[str, Path] = field(default_factory=dict)
    tables: tuple[str, ...] = ()
    seeds: int = 3
    cut: Cut = field(default_factory=Cut)

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise ConfigError(f"--seeds {self.seeds}: want at least 1")
        if self.paper == "hough":
            if self.given or self.tables or not self.cut.is_whole:
                raise ConfigError(
                    "hough has one table, of pairs of clouds: it has no --log, --tables, --first or --last"
                )
            return
        known = _PAPERS[self.paper].sequences
        if unknown := [name for name in self.tables if name not in known]:
            raise ConfigError(f"--tables {','.join(unknown)}: {self.paper} has {', '.join(known)}")


def reproduce(
    request: Request, out: Path, *, workers: Workers = IN_PROCESS, progress: Progress = SILENT
) -> Reproduction:
    """Measure what is not measured yet, and write all tables, ours with the printed figures.

    Args:
        request: Tables to measure, and their logs.
        out: Folder for tables, pictures, trajectories and finished cells; an unfinished one is completed.
        workers: Workers that measure; those of a scheduler see the logs and ``out`` under the same paths.
        progress: Receives stages, counts and notes.

    Raises:
        SourceError: None of the paper's logs is there.
        ConfigError: As for ``run_study``, or a log is named that the paper does not have.
        DataError: Nothing could be measured.
        RunError: OUT holds something else, or another process is filling it.
    """
    out = out.resolve()
    jobs: dict[Any, Job]
    if request.paper == "hough":
        jobs = hough_jobs(request.logs, seeds=request.seeds, pictures=out / PICTURES)
    else:
        sequences = _Sequences(request, _PAPERS[request.paper])
        jobs = sequences.jobs(out / PATHS)
    with resumable_folder(out, mark=PLAN):
        plan = {
            "paper": request.paper,
            "logs": str(request.logs.resolve()),
            "cells": {job.label: job.key for job in jobs.values()},
        }
        write_json(out / PLAN, plan, indent=1)
        results = run_study(jobs, out / CELLS, workers=workers, progress=progress)
        if all(result.failure for result in results.values()):
            first = next(iter(results.values()))
            raise DataError(f"nothing could be measured; {first.label}: {first.failure}")
        if request.paper == "hough":
            reproduction = hough_reproduction(results.values(), pictures=out / PICTURES)
        else:
            reproduction = sequences.reproduction(results)
        write_reproduction(out, reproduction)
    return reproduction


class _Sequences:
    def __init__(self, request: Request, paper: Paper) -> None:
        self._request, self._paper = request, paper
        self._tables = [name for name in paper.sequences if not request.tables or name in request.tables]
        names = dict.fromkeys(name for table in self._tables for name in paper.sequences[table])
        self._found: Found = find_sequences(request.logs, [*names], request.given)

    def jobs(self, paths: Path) -> dict[Any, Job]:
        """Return a job for every measurement."""
        request = self._request
        return {
            measurement: job_for(measurement)
            for name, log in self._found.logs.items()
            for seed in range(request.seeds)
            for measurement in self._paper.measurements(
                self._tables, name, log.resolve(), seed, request.cut, paths
            )
        }

    def reproduction(self, results: Mapping[Any, JobResult]) -> Reproduction:
        """Return the tables that anything was measured for."""
        cut = self._request.cut
        cut_notes = () if cut.is_whole else (f"Only frames {cut} of each sequence were used: no ratio.",)
        tables = (self._paper.table_of(name, results) for name in self._tables)
        return Reproduction(
            paper=self._paper.title,
            tables=tuple(
                replace(
                    table,
                    cells=tuple(replace(cell, in_part=not cut.is_whole) for cell in table.cells),
                    notes=(*cut_notes, *table.notes),
                )
                for table in tables
                if any(cell.ours or cell.failures for cell in table.cells)
            ),
            paths=tuple(self._paper.drawn([*results])),
            missing=self._found.missing,
            seeds=self._request.seeds,
            notes=self._found.notes,
        )
