"""From measurements of a paper's logs to its tables: each job fills some cells, for one seed."""

import hashlib
import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from evaluators.metrics.trajectory import align, associate, ate
from evaluators.papers.model import PaperCell
from evaluators.papers.published import Figures
from evaluators.study.cells import Cell, CellResult
from evaluators.sweep.build_job import environment
from evaluators.tables.table import Record
from mapper.config.build import BuildConfig
from mapper.core.trajectory import Trajectory
from mapper.run.fingerprint import fingerprint

CONFIGS = Path(__file__).with_name("configs")
"""The settings of the papers' methods: ``thesis/*.toml`` and ``zhao.toml``."""


class Place(NamedTuple):
    """Where a figure belongs."""

    table: str
    row: str
    column: str


class Measurement(Protocol):
    """One log measured once, for some cells; can be pickled."""

    @property
    def name(self) -> str:
        """What is measured, as a part of a file's name."""
        ...

    @property
    def log(self) -> Path:
        """Where it lies."""
        ...

    @property
    def seed(self) -> int:
        """Of the method's random draws."""
        ...

    @property
    def places(self) -> Sequence[Place]:
        """Which figures it gives."""
        ...

    def configs(self) -> Mapping[str, BuildConfig]:
        """Return what is run, by what it is called."""
        ...

    def __call__(self) -> list[Record]:
        """Return ``measured`` and ``failed`` records, one for every place."""
        ...


def measured(place: Place, value: float, note: str = "") -> Record:
    """Return the record of a figure; the note is what a reader of its table has to know."""
    return {**place._asdict(), "value": value, "note": note, "failure": None}


def failed(place: Place, reason: str) -> Record:
    """Return the record of a figure that the method could not give."""
    return {**place._asdict(), "value": None, "note": "", "failure": reason}


def cell_for(job: Measurement) -> Cell:
    """Return a measurement as a cell whose key changes with whatever could change its figures."""
    configs = {name: config.model_dump(mode="json") for name, config in job.configs().items()}
    text = json.dumps([environment(), _fingerprint(job.log), configs], sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:12]
    return Cell(f"{job.name}.seed{job.seed}.{digest}", f"{job.name}, seed {job.seed}", job)


def cells_of(
    table: str, jobs: Sequence[Measurement], results: Sequence[CellResult], printed: Figures
) -> tuple[PaperCell, ...]:
    """Return a table's cells in the order in which the jobs name them, all seeds of a cell together."""
    values: dict[Place, list[float]] = defaultdict(list)
    failures: dict[Place, list[str]] = defaultdict(list)
    places: dict[Place, None] = {}
    for job, result in zip(jobs, results, strict=True):
        here = [place for place in job.places if place.table == table]
        places |= dict.fromkeys(here)
        for place in here if result.failure else ():
            failures[place].append(f"seed {job.seed}: {result.failure}")
        for place, record in _records_of(table, result):
            if record["failure"] is None:
                values[place].append(float(record["value"]))
            else:
                failures[place].append(f"seed {job.seed}: {record['failure']}")
    return tuple(
        PaperCell(
            row=place.row,
            column=place.column,
            published=printed.get(place.row, {}).get(place.column),
            ours=tuple(values[place]),
            failures=tuple(failures[place]),
        )
        for place in places
    )


def notes_of(table: str, results: Sequence[CellResult]) -> tuple[str, ...]:
    """Return what the measurements of a table have to say, each sentence once."""
    notes = (record["note"] for result in results for _, record in _records_of(table, result))
    return tuple(dict.fromkeys(str(note) for note in notes if note))


def ate_rmse_m(estimate: Trajectory, truth: Trajectory) -> float:
    """Return the ATE RMSE after SE(3) alignment: the thesis's ATE, Zhao's APE (eq. 15, 16)."""
    matched = associate(estimate, truth)
    return ate(align(matched, "se3").moved(matched)).rmse


_fingerprint = cache(fingerprint)  # of a large log it takes a while, and every job asks


def _records_of(table: str, result: CellResult) -> list[tuple[Place, Mapping[str, Any]]]:
    return [
        (Place(table, str(record["row"]), str(record["column"])), record)
        for record in result.records
        if record["table"] == table
    ]
