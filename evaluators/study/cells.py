"""Cells of a table that take long: each is worked out once, wherever and however often the work is begun."""

import json
import math
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from evaluators.tables.table import Record
from mapper.core.errors import DataError
from mapper.runtime.atomic import locked, write_text
from mapper.runtime.executor import Failure, run_jobs
from mapper.runtime.progress import SILENT, Progress

_FORMAT = "mapper cell 1"
_KEY = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")


@dataclass(frozen=True, slots=True)
class Cell:
    """Work whose result is a few rows of a table.

    Attributes:
        key: The same for the same result, in other sessions too, so hashes of all that decides it; the file's
            name.
        label: What to call it when it fails.
        run: Does the work, and can be pickled; ``mapper.runtime.executor`` says how. None stands for an unknown value.
    """

    key: str
    label: str
    run: Callable[[], list[Record]]

    def __post_init__(self) -> None:
        if not _KEY.fullmatch(self.key):
            raise DataError(f"cell {self.key!r}: its key is a file's name; want {_KEY.pattern}")


@dataclass(frozen=True, slots=True)
class CellResult:
    """What became of a cell.

    Attributes:
        key: The cell's.
        label: The cell's.
        records: Its rows; none if it failed.
        seconds: How long it took, wherever that was; 0 if it failed.
        failure: Why it failed, in one line, or empty.
    """

    key: str
    label: str
    records: tuple[Record, ...]
    seconds: float
    failure: str = ""


def run_cells(
    cells: Sequence[Cell],
    folder: Path,
    *,
    processes: int = 1,
    scheduler: str | None = None,
    attempts: int = 2,
    progress: Progress = SILENT,
) -> list[CellResult]:
    """Return every cell's result, in their order; what was worked out before is not worked out again.

    Each finished cell is written to ``folder/KEY.json`` by whoever worked it out, so that nothing finished is
    lost when any of them dies. A failed cell is written too, and tried again the next time. Cells with the
    same key are worked out once.

    Args:
        cells: What to work out.
        folder: Where results are; with a scheduler, a place that all of its workers see.
        processes: As for ``run_jobs``.
        scheduler: As for ``run_jobs``.
        attempts: As for ``run_jobs``.
        progress: Is told of the cells that are left, so that the expected end holds.

    Raises:
        RunError: Another process is at work on the folder.
        ConfigError: As for ``run_jobs``.
    """
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        wanted = {cell.key: cell for cell in cells}
        results = {key: found for key in wanted if (found := _finished(folder, key, progress)) is not None}
        left = [cell for key, cell in wanted.items() if key not in results]
        if results:
            progress.note(f"{len(results)} of {len(wanted)} cells were finished before and are kept")
        if left:
            with progress.stage("cells") as report:
                report(0, len(left))
                jobs = [_Job(cell, folder) for cell in left]
                done = run_jobs(jobs, processes=processes, scheduler=scheduler, attempts=attempts)
                for number, (index, outcome) in enumerate(done, start=1):
                    results[left[index].key] = _settled(left[index], outcome, folder, progress)
                    report(number, len(left))
    return [replace(results[cell.key], label=cell.label) for cell in cells]


def _settled(cell: Cell, outcome: CellResult | Failure, folder: Path, progress: Progress) -> CellResult:
    """Return what became of a cell, after a failure has been told and written down."""
    if isinstance(outcome, CellResult):
        return outcome
    result = CellResult(cell.key, cell.label, (), 0.0, outcome.reason)
    _write(folder, result)
    progress.note(f"{cell.label}: {outcome.reason}")
    return result


@dataclass(frozen=True, slots=True)
class _Job:
    cell: Cell
    folder: Path

    def __call__(self) -> CellResult:
        began = time.perf_counter()
        records = tuple(map(_plain, self.cell.run()))
        result = CellResult(self.cell.key, self.cell.label, records, time.perf_counter() - began)
        _write(self.folder, result)
        return result


def _plain(record: Record) -> Record:
    """Return the record, refusing what a file would not give back as it was."""
    for name, value in record.items():
        finite = math.isfinite(value) if isinstance(value, float) else isinstance(value, str | int | None)
        if not finite:
            raise DataError(f"{name} is {value!r}; want text, a finite number or None")
    return dict(record)


def _write(folder: Path, result: CellResult) -> None:
    text = json.dumps({"format": _FORMAT, **asdict(result)}, indent=1, ensure_ascii=False, allow_nan=False)
    write_text(folder / f"{result.key}.json", text + "\n")


def _finished(folder: Path, key: str, progress: Progress) -> CellResult | None:
    """Return what a cell came to before, or None if it is still to be worked out."""
    path = folder / f"{key}.json"
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        if tree.pop("format") != _FORMAT or tree["key"] != key:
            raise ValueError
        result = CellResult(**tree | {"records": tuple(map(_plain, tree["records"]))})
    except FileNotFoundError:
        return None
    except (ValueError, TypeError, KeyError, AttributeError, DataError):
        progress.note(f"{path}: is no finished cell, or a damaged one; it is worked out again")
        return None
    return None if result.failure else result
