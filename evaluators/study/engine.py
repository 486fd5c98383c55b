"""Engine of compare, sweep and reproduce: method × log × settings → rows, a resumable job for each cell."""

from collections.abc import Hashable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from mapper.evaluators.study.versions import SameVersions, versions
from mapper.runtime.atomic import locked
from mapper.runtime.executor import IN_PROCESS, Workers, make_executor
from mapper.runtime.progress import SILENT, Progress
from mapper.runtime.resumable_jobs import Job, JobResult, JobRunner

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
