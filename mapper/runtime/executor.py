"""Executors: run jobs on processes of this machine or on a Dask cluster; a crash costs one job only.

Every local worker is a process of its own with one job at a time, so it is known which job ended it. A Dask
cluster has to run the same version of this package on the same files: its workers see a shared file system.
"""

import logging
import re
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar

from mapper.core.errors import ConfigError, MapperError
from mapper.runtime.extras import extra, one_thread_per_library
from mapper.runtime.worker_process import WorkerEndedError, WorkerProcess

if TYPE_CHECKING:
    from distributed import Future

Work = Callable[[], Any]


@dataclass(frozen=True, slots=True)
class Failure:
    """Result of a job that did not finish.

    Attributes:
        reason: One line: a MapperError's message, another exception's type, message and place, or how the
            worker ended.
        attempts: Number of times that the job was begun.
    """

    reason: str
    attempts: int


def attempt(job: Work) -> Any:
    """Return a job's result, or a Failure."""
    try:
        return job()
    except Exception as error:
        return Failure(reason_of(error), 1)


def reason_of(error: BaseException) -> str:
    """Return why a job failed, in one line; of an error that is not ours also where it was raised."""
    message = " ".join(str(error).split())
    if isinstance(error, MapperError):
        return "; ".join([message, *getattr(error, "__notes__", ())])
    where = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(where[-1].filename).name}:{where[-1].lineno})" if where else ""
    return f"{type(error).__name__}: {message}{place}"


R = TypeVar("R")

_ANSWER_S = 10.0
_ADDRESS = re.compile(r"(tcp|tls|wss?)://.+:\d+")


@dataclass(frozen=True, slots=True)
class Workers:
    """Workers: this process, processes of this machine, or a Dask cluster.

    Attributes:
        processes: Workers on this machine, each with one thread per library; 1 works in this process.
        scheduler: Address of a Dask scheduler, ``tcp://host:8786``; replaces ``processes``.
    """

    processes: int = 1
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.processes < 1:
            raise ConfigError(f"processes: {self.processes}, want at least 1")


IN_PROCESS = Workers()
"""One job at a time, in this process."""


class Executor(Protocol):
    """Workers that run jobs, at most as many at once as its size. Leaving it as a context ends the work."""

    def __enter__(self) -> Self: ...
    def __exit__(self, *_: object) -> None: ...

    def size(self) -> int:
        """Return how many jobs can run at once."""
        ...

    def submit(self, index: int, job: Work) -> None:
        """Begin a job."""
        ...

    def next_done(self) -> tuple[int, Any]:
        """Wait for a job to end, and return its index and its result or Failure."""
        ...


def make_executor(workers: Workers, *, jobs: int | None = None) -> Executor:
    """Return an executor for one or several lists of jobs, one after the other.

    Args:
        workers: Workers that run the jobs.
        jobs: Number of jobs, if that is known: no more processes are started.

    Raises:
        ConfigError: The scheduler does not answer, or has no workers.
        DependencyError: There is a scheduler, but Dask's ``distributed`` is not installed.
    """
    if workers.scheduler is not None:
        return _DaskCluster(workers.scheduler)
    processes = workers.processes if jobs is None else min(workers.processes, jobs)
    return _ProcessPool(processes) if processes > 1 else _InProcess()


def run_jobs(
    jobs: Sequence[Callable[[], R]], executor: Executor, *, attempts: int = 2
) -> Iterator[tuple[int, R | Failure]]:
    """Yield the index of each job and its result as they finish, in any order.

    A job that raises, or whose worker ends, is tried again after the others; the others go on.

    Args:
        jobs: Callables that can be pickled: a ``functools.partial`` of a module's function, or a frozen
            dataclass with ``__call__``. Their results travel through a pipe, so big ones belong in files.
        executor: Leaving it, as Ctrl-C does, ends local workers at once; a Dask worker finishes its job.
        attempts: Number of times that a job is begun before it is given up. Dask itself begins a job whose
            worker ended again on others, as its ``allowed-failures`` says.

    Raises:
        ConfigError: ``attempts`` is not positive, or the scheduler went away.
    """
    if attempts < 1:
        raise ConfigError(f"attempts: {attempts}, want at least 1")
    waiting, begun = deque(range(len(jobs))), Counter[int]()
    running = 0
    while waiting or running:
        while waiting and running < executor.size():
            index = waiting.popleft()
            executor.submit(index, jobs[index])
            running += 1
        index, outcome = executor.next_done()
        running -= 1
        if isinstance(outcome, Failure):
            begun[index] += outcome.attempts
            if begun[index] < attempts:
                waiting.append(index)
                continue
            outcome = Failure(outcome.reason, begun[index])
        yield index, outcome


class _InProcess(AbstractContextManager["_InProcess"]):
    def __exit__(self, *_: object) -> None:
        pass

    def size(self) -> int:
        return 1

    def submit(self, index: int, job: Work) -> None:
        self._index, self._job = index, job

    def next_done(self) -> tuple[int, Any]:
        return self._index, attempt(self._job)


class _ProcessPool(AbstractContextManager["_ProcessPool"]):
    """Executor of processes on this machine, started when there is work and replaced when they end."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._idle: list[WorkerProcess] = []
        self._busy: dict[int, WorkerProcess] = {}
        self._threads = ThreadPoolExecutor(count, thread_name_prefix="worker")
        self._done: SimpleQueue[tuple[int, Any, bool]] = SimpleQueue()

    def __exit__(self, *_: object) -> None:
        for worker in [*self._idle, *self._busy.values()]:
            worker.kill()
        self._threads.shutdown(cancel_futures=True)

    def size(self) -> int:
        return self._count

    def submit(self, index: int, job: Work) -> None:
        worker = self._busy[index] = self._idle.pop() if self._idle else WorkerProcess()
        self._threads.submit(self._run, worker, index, job)

    def _run(self, worker: WorkerProcess, index: int, job: Work) -> None:
        try:
            outcome, error = worker.call(partial(attempt, job))
        except WorkerEndedError as ended:
            self._done.put((index, Failure(f"its worker {ended}", 1), False))
            return
        except Exception as unpicklable:
            outcome, error = None, unpicklable
        self._done.put((index, outcome if error is None else Failure(reason_of(error), 1), True))

    def next_done(self) -> tuple[int, Any]:
        index, outcome, is_alive = self._done.get()
        worker = self._busy.pop(index)
        if is_alive:
            self._idle.append(worker)
        return index, outcome


class _DaskCluster(AbstractContextManager["_DaskCluster"]):
    def __init__(self, scheduler: str) -> None:
        if not _ADDRESS.fullmatch(scheduler):  # Dask itself would try for a while first
            raise ConfigError(f"scheduler {scheduler!r}: not an address; want tcp://HOST:PORT")
        with extra("cluster", "a Dask scheduler"):
            import distributed
        self._scheduler, self._killed = scheduler, distributed.KilledWorker
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # what matters is raised here
        try:
            self._client = distributed.Client(scheduler, timeout=_ANSWER_S, set_as_default=False)
        except OSError:
            raise ConfigError(
                f"{scheduler}: no Dask scheduler answers there within {_ANSWER_S:g} s; is it running?"
            ) from None
        try:
            self._client.wait_for_workers(1, timeout=_ANSWER_S)
        except TimeoutError:
            self._client.close()
            raise ConfigError(
                f"{scheduler}: no worker has joined it; start some: dask worker {scheduler} --nthreads 1"
            ) from None
        self._done = distributed.as_completed(loop=self._client.loop)
        self._index_of: dict[Future[Any], int] = {}

    def __exit__(self, *_: object) -> None:
        with suppress(OSError, TimeoutError):
            self._client.close(timeout=_ANSWER_S)

    def size(self) -> int:
        try:
            threads: dict[str, int] = self._client.nthreads()
        except OSError:
            raise self._gone() from None
        return max(sum(threads.values()), 1)

    def submit(self, index: int, job: Work) -> None:
        future = self._client.submit(_attempt_with_limits, job, pure=False)
        self._index_of[future] = index
        self._done.add(future)

    def next_done(self) -> tuple[int, Any]:
        future = next(self._done)
        index = self._index_of.pop(future)
        if future.cancelled():
            raise self._gone()
        try:
            error = future.exception()
            if error is None:
                return index, future.result()
        except OSError:
            raise self._gone() from None
        if isinstance(error, self._killed):
            begun = error.allowed_failures + 1
            return index, Failure(f"its worker ended, {begun} of {begun} times; its log may say why", begun)
        return index, Failure(reason_of(error), 1)

    def _gone(self) -> ConfigError:
        return ConfigError(f"{self._scheduler}: the Dask scheduler went away before all jobs were done")


def _attempt_with_limits(job: Work) -> Any:
    one_thread_per_library()
    return attempt(job)
