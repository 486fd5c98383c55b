"""Jobs whose results are kept in a folder, so that a merge that was stopped goes on where it was."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from mapper.core.config import Config
from mapper.core.errors import RunError
from mapper.runtime.atomic import write_text
from mapper.runtime.executor import Crew, Failure, run_jobs
from mapper.runtime.progress import Progress

Result = TypeVar("Result", bound=Config)


@dataclass(frozen=True, slots=True)
class Foreman:
    """Gives out jobs and keeps what became of them.

    Attributes:
        folder: Where results are kept.
        crew: Who does the jobs.
        progress: Who watches.
    """

    folder: Path
    crew: Crew
    progress: Progress

    def run(
        self, stage: str, jobs: Mapping[str, Callable[[], Result]], kind: type[Result]
    ) -> Iterator[tuple[str, Result]]:
        """Yield the name and the result of every job, those known from an earlier start first.

        Args:
            stage: What the jobs are called together.
            jobs: By name, which is what they are known by when the merge is started again.
            kind: Of the results.

        Raises:
            RunError: A job failed twice; the others were done.
        """
        kept = {name: self.folder / f"{stage}-{name}.json" for name in jobs}
        done = [name for name in jobs if kept[name].exists()]
        begun = [name for name in jobs if name not in set(done)]
        failures: list[str] = []
        with self.progress.stage(stage) as report:
            for count, name in enumerate(done, start=1):
                report(count, len(jobs))
                yield name, kind.model_validate_json(kept[name].read_bytes())
            outcomes = run_jobs([jobs[name] for name in begun], crew=self.crew)
            for count, (index, outcome) in enumerate(outcomes, start=len(done) + 1):
                report(count, len(jobs))
                if isinstance(outcome, Failure):
                    failures.append(f"{stage} {begun[index]}: {outcome.reason}")
                    continue
                write_text(kept[begun[index]], outcome.model_dump_json())
                yield begun[index], outcome
        if failures:
            more = f" (and {len(failures) - 1} more)" if len(failures) > 1 else ""
            raise RunError(f"{failures[0]}{more}; what is done stays: give the same command to go on")
