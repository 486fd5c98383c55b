"""A paper: its printed figures, its sequences at hand, and measurements of them, a job for each and seed."""

import json
import re
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple

from mapper.config.build import BuildConfig
from mapper.core.errors import ConfigError, DataError, SourceError
from mapper.core.trajectory import Trajectory, with_rotations
from mapper.evaluators.papers.model import PaperCell, PaperPath, PaperTable
from mapper.evaluators.study.engine import digest, versions
from mapper.evaluators.study.table import Record
from mapper.run.input_logs import fingerprint
from mapper.runtime.resumable_jobs import Job, JobResult
from mapper.sources import open_source
from mapper.sources.base import Log

Figures = Mapping[str, Mapping[str, float | None]]
"""Row, column, figure."""


@cache
def published() -> dict[str, Any]:
    """Return the papers' tables by name; every table carries its ``source``."""
    text = files("mapper.evaluators.papers").joinpath("published.json").read_text("utf-8")
    tables: dict[str, Any] = json.loads(text)
    return tables


def figures(name: str, *, rows: Literal["as printed", "the columns"] = "as printed") -> Figures:
    """Return a table's figures by row and column, or turned on its side."""
    table = published()[name]
    printed = {
        str(row): dict(zip(table["columns"], values, strict=True)) for row, values in table["rows"].items()
    }
    if rows == "as printed":
        return printed
    return {column: {row: printed[row][column] for row in printed} for column in table["columns"]}


_RECORDINGS = frozenset({".bag", ".mcap", ".mbag"})
_WRAPPING = re.compile(r"^(rgbd_dataset_|tum_)+")
_ALSO = {"fr3_long_office_household": "fr3_long_office", "trajectory1": "poznan_trajectory1"}
LOOKED_FOR = (
    "folders and recordings (.bag, .mcap, .mbag) called as TUM calls them, rgbd_dataset_freiburg1_xyz, "
    "or freiburg1_xyz, fr1_xyz, tum_fr1_xyz"
)


@dataclass(frozen=True, slots=True)
class Found:
    """Sequences of a paper that are at hand.

    Attributes:
        logs: The log of each, in the paper's order.
        missing: The others, in the paper's order.
        notes: Sentences on what was ambiguous.
    """

    logs: Mapping[str, Path]
    missing: tuple[str, ...]
    notes: tuple[str, ...]


def find_sequences(folder: Path, names: Sequence[str], given: Mapping[str, Path]) -> Found:
    """Find a paper's sequences in a folder, which may be one of them itself, and in the folders in it.

    Args:
        folder: Folder that is searched.
        names: Names in the paper, e.g. "fr1/xyz".
        given: Paths of logs of other names; these come first.

    Raises:
        SourceError: The folder is missing, or none of the sequences is there.
        ConfigError: A given name is none of the paper's, or nothing is there.
    """
    for name, path in given.items():
        if name not in names:
            raise ConfigError(f"--log {name}={path}: no sequence of the paper; it has {', '.join(names)}")
        if not path.exists():
            raise ConfigError(f"--log {name}={path}: no such file or folder")
    if not folder.exists():
        raise SourceError(f"{folder}: no such file or folder")
    name_of = {_key(name): name for name in names}
    found: dict[str, Path] = dict(given)
    notes = []
    for path in _logs(folder, frozenset(name_of)):
        name = name_of[_key(_stem(path))]
        if name in given:
            continue
        if name in found:
            notes.append(f"{name} is there twice: {found[name]} is used, not {path}")
        found.setdefault(name, path)
    if not found:
        raise SourceError(
            f"{folder}: none of the sequences is there ({', '.join(names)}); looked for {LOOKED_FOR}; "
            f"a log of another name: --log {names[0]}=PATH"
        )
    return Found(
        {name: found[name] for name in names if name in found},
        tuple(name for name in names if name not in found),
        tuple(notes),
    )


def slug(name: str) -> str:
    """Return a sequence's name as a part of a file's: "fr1/xyz" becomes "fr1_xyz"."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _logs(folder: Path, keys: Iterable[str]) -> Iterator[Path]:
    """Yield the logs named like a sequence: the folder itself, or its children and theirs."""
    if _key(_stem(folder.resolve())) in keys:
        yield folder
    elif folder.is_dir():
        for child in sorted(folder.iterdir()):
            if _is_log_of(child, keys):
                yield child
            elif child.is_dir():
                yield from (inner for inner in sorted(child.iterdir()) if _is_log_of(inner, keys))


def _is_log_of(path: Path, keys: Iterable[str]) -> bool:
    return (path.is_dir() or path.suffix.lower() in _RECORDINGS) and _key(_stem(path)) in keys


def _stem(path: Path) -> str:
    return path.stem if path.suffix.lower() in _RECORDINGS else path.name


def _key(name: str) -> str:
    """Return the part that all names of a sequence have in common: "fr1_xyz"."""
    key = _WRAPPING.sub("", slug(name.replace("ń", "n")))
    key = re.sub(r"^(?:freiburg|fr)_?(\d)_?", r"fr\1_", key)
    return _ALSO.get(key, key)


CONFIGS = Path(__file__).with_name("configs")
"""The settings of the papers' methods: ``thesis/*.toml`` and ``zhao.toml``."""


class Place(NamedTuple):
    """Place of a figure in a paper."""

    table: str
    row: str
    column: str


@dataclass(frozen=True, slots=True)
class Cut:
    """Range of the frames that are used of every sequence.

    Attributes:
        first: Index of the first.
        last: Index of the last; None is the log's.
    """

    first: int = 0
    last: int | None = None

    def __post_init__(self) -> None:
        if self.first < 0 or (self.last is not None and self.last < self.first):
            raise ConfigError(f"--first {self.first} --last {self.last}: want 0 ≤ first ≤ last")

    @property
    def is_whole(self) -> bool:
        """Nothing is cut."""
        return self == Cut()

    def __str__(self) -> str:
        return f"{self.first} … {'end' if self.last is None else self.last}"

    def overrides(self, most: int | None = None) -> list[str]:
        """Return the settings that choose these frames; a paper may itself limit the number of frames."""
        ends = [] if self.last is None else [self.last]
        if most is not None:
            ends.append(most - 1)
        return [f"source.first_frame={self.first}", *(f"source.last_frame={end}" for end in sorted(ends)[:1])]


@dataclass(frozen=True, slots=True)
class Measurement(ABC):
    """One sequence measured once, for some figures; can be pickled.

    Attributes:
        sequence: Name of the sequence in the paper.
        log: Its folder or file.
        seed: Seed of the method's random draws.
        cut: Frames that are used.
    """

    sequence: str
    log: Path
    seed: int
    cut: Cut

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the measurement, as a part of a file's name."""

    @property
    @abstractmethod
    def places(self) -> Sequence[Place]:
        """Places of the figures that it gives."""

    @abstractmethod
    def configs(self) -> Mapping[str, BuildConfig]:
        """Return the settings that are run, with the seed and the frames in use, by name."""

    @abstractmethod
    def __call__(self) -> list[Record]:
        """Return ``measured`` and ``failed`` records, one for every place."""


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
    truth = with_rotations(source.truth)
    if truth is None:
        raise DataError(f"{log}: has no ground truth, so its error is unknown")
    return source, truth


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


_fingerprint = cache(fingerprint)  # of a large log it takes a while, and every measurement needs it


def _records_of(table: str, result: JobResult) -> list[tuple[Place, Mapping[str, Any]]]:
    return [
        (Place(table, str(record["row"]), str(record["column"])), record)
        for record in result.records
        if record["table"] == table
    ]


@dataclass(frozen=True, slots=True)
class Paper:
    """A paper.

    Attributes:
        title: Who wrote it, and where.
        sequences: The sequences of each table, by what tables are called on the command line.
        measurements: Returns what is to be measured of a sequence for some tables, with a seed: takes the
            tables, the sequence, its log, the seed, which frames, and a folder for trajectories.
        table_of: Returns a table with the results of all measurements.
        drawn: Returns the trajectories that measurements have left.
    """

    title: str
    sequences: dict[str, list[str]]
    measurements: Callable[[Sequence[str], str, Path, int, Cut, Path], Sequence[Measurement]]
    table_of: Callable[[str, Mapping[Any, JobResult]], PaperTable]
    drawn: Callable[[Sequence[Any]], Sequence[PaperPath]] = lambda _: ()
