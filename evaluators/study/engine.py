"""Engine of compare, sweep and reproduce: method × log × settings → rows, a resumable job for each cell."""

import hashlib
import json
import platform
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import mapper
from mapper.core.config import AnyConfig, with_changes
from mapper.core.errors import ConfigError
from mapper.run.manifest import library_versions
from mapper.runtime.atomic import locked
from mapper.runtime.executor import IN_PROCESS, Workers, make_executor
from mapper.runtime.progress import SILENT, Progress
from mapper.runtime.resumable_jobs import Job, JobResult, JobRunner, Record

CELLS = "cells"
"""Folder of the results beside a study's tables."""

Place = TypeVar("Place", bound=Hashable)


def run_study(
    jobs: Mapping[Place, Job],
    folder: Path,
    *,
    workers: Workers = IN_PROCESS,
    attempts: int = 2,
    progress: Progress = SILENT,
) -> dict[Place, JobResult]:
    """Return the result of every job, in their order; what an earlier session has finished is not run again.

    A failed job has a result that says why, and is run again the next time. Jobs with the same key are run
    once.

    Args:
        jobs: Jobs by the place in a table that they fill.
        folder: Folder of the results; with a scheduler, a place that all of its workers see.
        workers: Workers that run the jobs.
        attempts: Number of times that a job is begun before it has failed.
        progress: Receives the count of the jobs that are left, so that the expected end holds, and failures.

    Raises:
        RunError: Another process is at work on the folder.
        ConfigError: The scheduler does not answer, has no workers or went away.
        DependencyError: There is a scheduler, but Dask's ``distributed`` is not installed.
    """
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    wanted = {job.key: job for job in jobs.values()}
    runner = JobRunner(folder, progress)
    with locked(folder):
        results = runner.finished(wanted.values())
        if results:
            progress.note(f"{len(results)} of {len(wanted)} cells were finished before and are kept")
        planned = versions()
        left = [
            replace(job, run=SameVersions(job.run, planned))
            for key, job in wanted.items()
            if key not in results
        ]
        if left:
            with make_executor(workers, jobs=len(left)) as executor, progress.stage("cells") as report:
                report(0, len(left))
                done = runner.run(left, executor, attempts=attempts)
                for number, result in enumerate(done, start=1):
                    results[result.key] = result
                    if result.failure:
                        progress.note(f"{result.label}: {result.failure}")
                    report(number, len(left))
    return {place: replace(results[job.key], label=job.label) for place, job in jobs.items()}


def versions() -> dict[str, str]:
    """Return the versions of all that can change a result."""
    return {"mapper": mapper.__version__, **library_versions()}


def digest(*decides: Any, digits: int) -> str:
    """Return the first hexadecimal digits of the SHA-256 of everything that a result depends on, as JSON."""
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:digits]


@dataclass(frozen=True, slots=True)
class SameVersions:
    """Work that a machine with other versions of the libraries refuses.

    Attributes:
        work: The work; can be pickled.
        planned: The versions where its key was made.
    """

    work: Callable[[], Sequence[Record]]
    planned: Mapping[str, str]

    def __call__(self) -> Sequence[Record]:
        """Return the work's records.

        Raises:
            ConfigError: This machine has another version of a library, so results would not compare.
        """
        for name, version in versions().items():
            planned = self.planned.get(name)
            if version != planned:
                raise ConfigError(
                    f"worker on {platform.node()}: {name} {version}, where the work was planned with "
                    f"{planned}; results would not compare, so install the same"
                )
        return self.work()


_SEEDS = frozenset({"seed", "ransac_seed"})


def seeded(config: AnyConfig, seed: int) -> AnyConfig:
    """Return a configuration with every seed in it set; the same configuration if it has none."""
    return with_changes(config, lambda name, value: seed if name in _SEEDS else value)
