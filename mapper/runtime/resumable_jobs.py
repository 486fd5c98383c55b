"""Resumable jobs: each result is kept in a file, so work that was stopped can be resumed."""

import json
import math
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from pydantic import BaseModel

from mapper.core.errors import DataError, RunError
from mapper.runtime.atomic import write_text
from mapper.runtime.executor import Executor, Failure, run_jobs
from mapper.runtime.progress import SILENT, Progress, peak_memory_mb

Record = Mapping[str, Any]
"""Names with text, finite numbers, None, or lists and mappings of these."""

Result = TypeVar("Result", bound=BaseModel)

_FORMAT = "mapper cell 1"
_KEY = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")


@dataclass(frozen=True, slots=True)
class Job:
    """Work whose result is a few records.

    Attributes:
        key: Name of the result's file. The same key stands for the same result, in other sessions too, so it
            is a hash of all that the result depends on unless its folder is for one piece of work alone.
        label: Name of the job in messages.
        run: Does the work, and can be pickled; ``mapper.runtime.executor`` says how.
    """

    key: str
    label: str
    run: Callable[[], Sequence[Record]]

    def __post_init__(self) -> None:
        if not _KEY.fullmatch(self.key):
            raise DataError(f"job {self.key!r}: its key is a file's name; want {_KEY.pattern}")


@dataclass(frozen=True, slots=True)
class JobResult:
    """Result of a job.

    Attributes:
        key: The job's.
        label: The job's.
        records: Records that its work returned; empty if it failed.
        seconds: Wall time of the work, wherever it ran; 0 if it failed.
        failure: Why it failed, in one line, or empty.
    """

    key: str
    label: str
    records: tuple[Record, ...]
    seconds: float
    failure: str = ""


@dataclass(frozen=True, slots=True)
class JobRunner:
    """Runs jobs and keeps each result in ``FOLDER/KEY.json``, written by the process that worked it out.

    So nothing finished is lost when any process ends. A failure is written too, and its job run again the
    next time.

    Attributes:
        folder: Folder of the results; a Dask cluster's workers must see it as well.
        progress: Receives notes of damaged files.
    """

    folder: Path
    progress: Progress = SILENT

    def finished(self, jobs: Iterable[Job]) -> dict[str, JobResult]:
        """Return the results that an earlier session has left, by key."""
        return {job.key: result for job in jobs if (result := self._read(job.key)) is not None}

    def run(self, jobs: Sequence[Job], executor: Executor, *, attempts: int = 2) -> Iterator[JobResult]:
        """Yield the result of every job as it finishes, in any order.

        Args:
            jobs: Jobs with different keys.
            executor: Executor that runs them.
            attempts: Number of times that a job is begun before it has failed.
        """
        folder = self.folder.resolve()
        outcomes = run_jobs([_KeptJob(job, folder) for job in jobs], executor, attempts=attempts)
        for index, outcome in outcomes:
            if isinstance(outcome, Failure):
                outcome = JobResult(jobs[index].key, jobs[index].label, (), 0.0, outcome.reason)
                _write(folder, outcome)
            yield outcome

    def _read(self, key: str) -> JobResult | None:
        """Return a job's result, or None if it is still to be worked out."""
        path = self.folder / f"{key}.json"
        try:
            tree = json.loads(path.read_text(encoding="utf-8"))
            if tree.pop("format") != _FORMAT or tree["key"] != key:
                raise ValueError
            result = JobResult(**tree | {"records": tuple(map(_checked, tree["records"]))})
        except FileNotFoundError:
            return None
        except (ValueError, TypeError, KeyError, AttributeError, DataError):
            self.progress.note(f"{path}: not a finished result, or a damaged one; it is computed again")
            return None
        return None if result.failure else result


@dataclass(frozen=True, slots=True)
class _KeptJob:
    job: Job
    folder: Path

    def __call__(self) -> JobResult:
        began = time.perf_counter()
        records = tuple(map(_checked, self.job.run()))
        result = JobResult(self.job.key, self.job.label, records, time.perf_counter() - began)
        _write(self.folder, result)
        return result


def _checked(record: Record) -> Record:
    """Return the record, refusing what a file would not give back as it was."""
    for name, value in record.items():
        if not isinstance(value, str | int | float | list | dict | None) or (
            isinstance(value, float) and not math.isfinite(value)
        ):
            raise DataError(f"{name} is {value!r}; want text, a finite number or None")
    return dict(record)


def _write(folder: Path, result: JobResult) -> None:
    text = json.dumps({"format": _FORMAT, **asdict(result)}, indent=1, ensure_ascii=False, allow_nan=False)
    write_text(folder / f"{result.key}.json", text + "\n")


class Cost(NamedTuple):
    """Cost of a job.

    Attributes:
        seconds: Wall time.
        peak_memory_mb: Peak memory of its process, since that began.
    """

    seconds: float
    peak_memory_mb: float


@dataclass(frozen=True, slots=True)
class Stages:
    """Stages of work: lists of jobs, one after the other, whose results are kept until all of it is done.

    Attributes:
        runner: Keeps their results, so that work that was stopped is resumed.
        executor: Executor of the jobs.
        progress: Receives how many are done.
        costs: Costs of the jobs of every stage so far, in no order.
    """

    runner: JobRunner
    executor: Executor
    progress: Progress
    costs: dict[str, list[Cost]] = field(default_factory=dict)

    def run(
        self, stage: str, work: Mapping[str, Callable[[], Result]], kind: type[Result]
    ) -> Iterator[tuple[str, Result]]:
        """Yield the name and the result of every job, those known from an earlier session first.

        Args:
            stage: Name of the jobs together.
            work: Functions by job name; work that is started again recognises its jobs by these names.
            kind: Type of the results.

        Raises:
            RunError: A job failed twice; the others were done.
        """
        jobs = {
            f"{stage}-{name}": Job(f"{stage}-{name}", f"{stage} {name}", partial(_as_records, one))
            for name, one in work.items()
        }
        finished = self.runner.finished(jobs.values())
        left = [job for key, job in jobs.items() if key not in finished]
        failures: list[str] = []
        costs = self.costs.setdefault(stage, [])
        with self.progress.stage(stage) as report:
            results = chain(finished.values(), self.runner.run(left, self.executor))
            for count, result in enumerate(results, start=1):
                report(count, len(jobs))
                if result.failure:
                    failures.append(f"{result.label}: {result.failure}")
                    continue
                record, memory = result.records
                costs.append(Cost(result.seconds, memory["peak_memory_mb"]))
                yield result.key.removeprefix(f"{stage}-"), kind.model_validate(record)
        if failures:
            more = f" (and {len(failures) - 1} more)" if len(failures) > 1 else ""
            raise RunError(f"{failures[0]}{more}; finished jobs are kept: give the same command to resume")


def _as_records(work: Callable[[], BaseModel]) -> list[Record]:
    return [work().model_dump(mode="json"), {"peak_memory_mb": peak_memory_mb()}]
