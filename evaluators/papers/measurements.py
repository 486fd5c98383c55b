"""Measurements of a paper's logs: each is a job that gives some figures of some tables, for one seed."""

from collections import defaultdict
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from mapper.config.build import BuildConfig
from mapper.core.errors import DataError
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.trajectory import align, associate, ate
from mapper.evaluators.papers.model import PaperCell, PaperTable
from mapper.evaluators.papers.published import Figures
from mapper.evaluators.study.versions import digest, versions
from mapper.evaluators.tables.table import Record
from mapper.run.input_logs import fingerprint
from mapper.runtime.resumable_jobs import Job, JobResult
from mapper.sources import open_source
from mapper.sources.base import Log

CONFIGS = Path(__file__).with_name("configs")
"""The settings of the papers' methods: ``thesis/*.toml`` and ``zhao.toml``."""


class Place(NamedTuple):
    """Place of a figure in a paper."""

    table: str
    row: str
    column: str


class Measurement(Hashable, Protocol):
    """One log measured once, for some figures; can be pickled."""

    @property
    def name(self) -> str:
        """Name of the measurement, as a part of a file's name."""
        ...

    @property
    def log(self) -> Path:
        """The log."""
        ...

    @property
    def seed(self) -> int:
        """Seed of the method's random draws."""
        ...

    @property
    def places(self) -> Sequence[Place]:
        """Places of the figures that it gives."""
        ...

    def configs(self) -> Mapping[str, BuildConfig]:
        """Return the settings that are run, by name."""
        ...

    def __call__(self) -> list[Record]:
        """Return ``measured`` and ``failed`` records, one for every place."""
        ...


Results = Mapping[Any, JobResult]
"""The results of measurements."""


def measured(place: Place, value: float, note: str = "") -> Record:
    """Return the record of a figure; the note is what a reader of its table has to know."""
    return {**place._asdict(), "value": value, "note": note, "failure": None}


def failed(place: Place, reason: str) -> Record:
    """Return the record of a figure that the method could not give."""
    return {**place._asdict(), "value": None, "note": "", "failure": reason}


def job_for(measurement: Measurement) -> Job:
    """Return a measurement as a job whose key changes with whatever could change its figures."""
    configs = {name: config.model_dump(mode="json") for name, config in measurement.configs().items()}
    decides = digest(versions(), _fingerprint(measurement.log), configs, digits=12)
    name, seed = measurement.name, measurement.seed
    return Job(f"{name}.seed{seed}.{decides}", f"{name}, seed {seed}", measurement)


def open_with_truth(log: Path, config: BuildConfig) -> tuple[Log, Trajectory]:
    """Return a log and its ground truth.

    Raises:
        DataError: It has none.
    """
    source = open_source(log, config.source)
    if source.truth is None:
        raise DataError(f"{log}: has no ground truth, so its error is unknown")
    return source, source.truth


def cells_of(table: str, results: Results, printed: Figures) -> tuple[PaperCell, ...]:
    """Return a table's cells in the order in which measurements name them, all seeds of a cell together."""
    values: dict[Place, list[float]] = defaultdict(list)
    failures: dict[Place, list[str]] = defaultdict(list)
    places: dict[Place, None] = {}
    for measurement, result in results.items():
        here = [place for place in measurement.places if place.table == table]
        places |= dict.fromkeys(here)
        for place in here if result.failure else ():
            failures[place].append(f"seed {measurement.seed}: {result.failure}")
        for place, record in _records_of(table, result):
            if record["failure"] is None:
                values[place].append(float(record["value"]))
            else:
                failures[place].append(f"seed {measurement.seed}: {record['failure']}")
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


def filled(name: str, table: PaperTable, cells: Sequence[PaperCell], results: Results) -> PaperTable:
    """Return a table with more cells, and with the notes of their measurements, each sentence once."""
    texts = (record["note"] for result in results.values() for _, record in _records_of(name, result))
    notes = dict.fromkeys(str(note) for note in texts if note)
    return replace(table, cells=(*table.cells, *cells), notes=(*table.notes, *notes))


def ate_rmse_m(estimate: Trajectory, truth: Trajectory) -> float:
    """Return the ATE RMSE after SE(3) alignment: the thesis's ATE, Zhao's APE (eq. 15, 16)."""
    matched = associate(estimate, truth)
    return ate(align(matched, "se3").moved(matched)).rmse


_fingerprint = cache(fingerprint)  # of a large log it takes a while, and every measurement needs it


def _records_of(table: str, result: JobResult) -> list[tuple[Place, Mapping[str, Any]]]:
    return [
        (Place(table, str(record["row"]), str(record["column"])), record)
        for record in result.records
        if record["table"] == table
    ]
