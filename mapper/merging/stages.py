"""Stages of a merge: lists of jobs, one after the other, whose results are kept until the map is whole."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from typing import NamedTuple, TypeVar

from mapper.core.config import Config
from mapper.core.errors import RunError
from mapper.runtime.executor import Executor
from mapper.runtime.progress import Progress
from mapper.runtime.resumable_jobs import Job, JobRunner, Record
from mapper.runtime.timing import peak_memory_mb

Result = TypeVar("Result", bound=Config)


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
    """Runs the jobs of each stage.

    Attributes:
        runner: Keeps their results, so that a merge that was stopped is resumed.
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
            work: Functions by job name; a merge that is started again recognises its jobs by these names.
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


def _as_records(work: Callable[[], Config]) -> list[Record]:
    return [work().model_dump(mode="json"), {"peak_memory_mb": peak_memory_mb()}]
