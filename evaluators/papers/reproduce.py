"""A paper's tables measured again on whatever of its logs are at hand; work that was killed goes on."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from evaluators.papers import thesis, zhao
from evaluators.papers.book import Book, Cut
from evaluators.papers.files import write_reproduction
from evaluators.papers.hough import hough_cells
from evaluators.papers.hough_tables import hough_reproduction
from evaluators.papers.measured import cell_for
from evaluators.papers.model import Reproduction
from evaluators.papers.sequences import Found, find_sequences
from evaluators.study.cells import Cell, CellResult, run_cells
from mapper.core.errors import ConfigError, DataError
from mapper.runtime.atomic import resumable_folder, write_text
from mapper.runtime.progress import SILENT, Progress

Paper = Literal["thesis", "zhao", "hough"]

CELLS, PATHS, PICTURES, PLAN = "cells", "trajectories", "pictures", "reproduce.json"
_BOOKS: Mapping[Paper, Book] = {"thesis": thesis.BOOK, "zhao": zhao.BOOK}


@dataclass(frozen=True, slots=True)
class Request:
    """What is to be measured again.

    Attributes:
        paper: Whose tables.
        logs: Folder in which to look for its logs.
        given: Where logs of other names lie, by what the paper calls them.
        tables: Which, e.g. "5.1"; empty is all.
        seeds: How many draws of whatever is random.
        cut: Which frames are used.
    """

    paper: Paper
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
                    "hough has one table, of pairs of clouds: it knows no --log, --tables, --first or --last"
                )
            return
        known = _BOOKS[self.paper].sequences
        if unknown := [name for name in self.tables if name not in known]:
            raise ConfigError(f"--tables {','.join(unknown)}: {self.paper} has {', '.join(known)}")


def reproduce(
    request: Request,
    out: Path,
    *,
    processes: int = 1,
    scheduler: str | None = None,
    progress: Progress = SILENT,
) -> Reproduction:
    """Measure what is not measured yet, and write all tables, ours beside the printed figures.

    Args:
        request: What to measure.
        out: Folder for tables, pictures, trajectories and finished cells; one that is there is gone on with.
        processes: As for ``run_cells``.
        scheduler: As for ``run_cells``; its workers have to see the logs and ``out`` under the same paths.
        progress: Who waits.

    Raises:
        SourceError: None of the paper's logs is there.
        ConfigError: As for ``run_jobs``, or a log is named that the paper does not have.
        DataError: Nothing could be measured.
        RunError: OUT holds something else, or another process is filling it.
    """
    work = _HoughWork(request) if request.paper == "hough" else _BookWork(request, _BOOKS[request.paper])
    cells = work.cells(out.resolve())
    with resumable_folder(out, mark=PLAN) as folder:
        write_text(folder / PLAN, _described(request, cells))
        results = run_cells(
            cells, folder / CELLS, processes=processes, scheduler=scheduler, progress=progress
        )
        if all(result.failure for result in results):
            raise DataError(f"nothing could be measured; {results[0].label}: {results[0].failure}")
        reproduction = work.reproduction(cells, results, folder)
        write_reproduction(folder, reproduction)
    return reproduction


class _HoughWork:
    """Pairs of clouds."""

    def __init__(self, request: Request) -> None:
        self._request = request

    def cells(self, folder: Path) -> list[Cell]:
        return hough_cells(self._request.logs, seeds=self._request.seeds, pictures=folder / PICTURES)

    def reproduction(
        self, _cells: Sequence[Cell], results: Sequence[CellResult], folder: Path
    ) -> Reproduction:
        return hough_reproduction(results, pictures=folder / PICTURES)


class _BookWork:
    """Sequences."""

    def __init__(self, request: Request, book: Book) -> None:
        self._request, self._book = request, book
        self._tables = [name for name in book.sequences if not request.tables or name in request.tables]
        names = dict.fromkeys(name for table in self._tables for name in book.sequences[table])
        self._found: Found = find_sequences(request.logs, [*names], request.given)

    def cells(self, folder: Path) -> list[Cell]:
        request, paths = self._request, folder / PATHS
        return [
            cell_for(job)
            for name, log in self._found.logs.items()
            for seed in range(request.seeds)
            for job in self._book.jobs(self._tables, name, log.resolve(), seed, request.cut, paths)
        ]

    def reproduction(
        self, cells: Sequence[Cell], results: Sequence[CellResult], _folder: Path
    ) -> Reproduction:
        jobs = [cell.run for cell in cells]
        cut = self._request.cut
        cut_notes = () if cut.is_whole else (f"Only frames {cut} of each sequence were used: no ratio.",)
        tables = (self._book.table_of(name, jobs, results) for name in self._tables)
        return Reproduction(
            paper=self._book.title,
            tables=tuple(
                replace(
                    table,
                    cells=tuple(replace(cell, in_part=not cut.is_whole) for cell in table.cells),
                    notes=(*cut_notes, *table.notes),
                )
                for table in tables
                if any(cell.ours or cell.failures for cell in table.cells)
            ),
            paths=tuple(self._book.drawn(jobs)),
            missing=self._found.missing,
            seeds=self._request.seeds,
            notes=self._found.notes,
        )


def _described(request: Request, cells: Sequence[Cell]) -> str:
    told = {
        "paper": request.paper,
        "logs": str(request.logs.resolve()),
        "cells": {cell.label: cell.key for cell in cells},
    }
    return json.dumps(told, indent=1, ensure_ascii=False) + "\n"
