"""Executors: run jobs on processes of this machine or on a Dask cluster; a crash costs one job only.

Every local worker is a process of its own with one job at a time, so it is known which job ended it. A Dask
cluster has to run the same version of this package on the same files: its workers see a shared file system.
"""

import logging
import os
import pickle
import re
import signal
import threading
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar

from mapper.core.errors import ConfigError, MapperError
from mapper.runtime.extras import extra, one_thread_per_library

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


class WorkerProcess:
    """A spawned process that runs the jobs sent to it, one at a time, and ends with its parent."""

    def __init__(self) -> None:
        context = get_context("spawn")  # a forked copy of a process with threads may hang
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()  # so that the pipe ends with the process

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()
        self._process.join()
        self.connection.close()

    def exit_reason(self) -> str:
        """Return how the process ended, after its end of the pipe has closed."""
        self._process.join()
        self.connection.close()
        code = self._process.exitcode or 0
        if code < 0:
            return f"its worker was killed by {signal.Signals(-code).name}"
        return f"its worker ended with exit status {code}"


def _serve(connection: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent handles it
    one_thread_per_library()
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    while True:
        try:
            packed = connection.recv_bytes()
        except EOFError:
            return
        outcome = attempt(partial(_unpacked, packed))
        try:
            connection.send(outcome)
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            connection.send(Failure(reason_of(error), 1))


def _unpacked(packed: bytes) -> Any:
    return pickle.loads(packed)()


def _exit_with_parent() -> None:
    """Exit once the parent has: a killed one cannot end its workers, which a second run must not find."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


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
        self._busy: dict[Connection, tuple[WorkerProcess, int]] = {}

    def __exit__(self, *_: object) -> None:
        for worker in [*self._idle, *(worker for worker, _ in self._busy.values())]:
            worker.kill()

    def size(self) -> int:
        return self._count

    def submit(self, index: int, job: Work) -> None:
        worker = self._idle.pop() if self._idle else WorkerProcess()
        with suppress(BrokenPipeError):  # it ended while idle; next_done will find the pipe closed
            worker.connection.send(job)
        self._busy[worker.connection] = worker, index

    def next_done(self) -> tuple[int, Any]:
        connection = wait(list(self._busy))[0]
        assert isinstance(connection, Connection)
        worker, index = self._busy.pop(connection)
        try:
            outcome = connection.recv()
        except (EOFError, ConnectionError):
            return index, Failure(worker.exit_reason(), 1)
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
