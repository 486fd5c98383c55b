"""Worker processes: each runs jobs one at a time, so that a job that crashes its process costs itself alone.

``python -m mapper.runtime.worker_process`` is that process: it takes pickled jobs on its standard input. It
does not import the main module, which a script that only reads a file need not allow for, and may be started
by another worker.
"""

import atexit
import os
import pickle
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any, BinaryIO, TypeVar, cast

from mapper.core.errors import DataError
from mapper.runtime.extras import one_thread_per_library

R = TypeVar("R")

_LENGTH = struct.Struct("<Q")

_idle: list["WorkerProcess"] = []


class WorkerEndedError(Exception):
    """A worker process ended before its job did; the message says how, as the end of a sentence."""


class WorkerProcess:
    """A process that runs the jobs sent to it, one at a time, and ends with its parent."""

    def __init__(self, *, is_silent: bool = False) -> None:
        """Start it.

        Args:
            is_silent: Drop what it prints, as a library that aborts prints its stack.
        """
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL if is_silent else None,
        )

    def call(self, job: Callable[[], R]) -> tuple[R | None, Exception | None]:
        """Return what a job returns, or None and what it raises.

        Args:
            job: A callable that can be pickled, as its result and exceptions can.

        Raises:
            WorkerEndedError: The process ended.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        data = pickle.dumps(job)
        try:
            _send(self._process.stdin, data)
            answer: tuple[R | None, Exception | None] = pickle.loads(_receive(self._process.stdout))
        except (BrokenPipeError, EOFError):
            code = self._process.wait()
            name = signal.Signals(-code).name if code < 0 else ""
            raise WorkerEndedError(
                f"was killed by {name}" if name else f"ended with exit status {code}"
            ) from None
        return answer

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()
        self._process.wait()


def _send(pipe: BinaryIO | Any, data: bytes) -> None:
    pipe.write(_LENGTH.pack(len(data)))
    pipe.write(data)
    pipe.flush()


def _receive(pipe: BinaryIO | Any) -> bytes:
    head = pipe.read(_LENGTH.size)
    length = _LENGTH.unpack(head)[0] if len(head) == _LENGTH.size else 0
    data: bytes = pipe.read(length)
    if not length or len(data) < length:
        raise EOFError
    return data


def call_isolated(job: Callable[[], R], *, memory_bytes: int) -> R:
    """Return what a job returns, or raise what it raises; the worker is kept for later calls.

    Args:
        job: A callable that can be pickled, as its result and exceptions can.
        memory_bytes: Limit of what it may allocate (Linux).

    Raises:
        DataError: The process ended; the message says how.
    """
    try:
        worker = _idle.pop()
    except IndexError:  # all are busy: one for each thread
        worker = WorkerProcess(is_silent=True)
    try:
        result, error = worker.call(partial(_limited, job, memory_bytes))
    except WorkerEndedError as ended:
        raise DataError(f"the process that reads it {ended}") from None
    except BaseException:
        worker.kill()
        raise
    _idle.append(worker)
    if error is not None:
        raise error
    return cast("R", result)


@atexit.register
def _kill_idle() -> None:
    while _idle:
        _idle.pop().kill()


def _limited(job: Callable[[], R], memory_bytes: int) -> R:
    with memory_limited(memory_bytes):
        return job()


@contextmanager
def memory_limited(more_bytes: int) -> Iterator[None]:
    """Limit the memory that this process may allocate in addition while inside (Linux)."""
    statm = Path("/proc/self/statm")
    if not statm.exists():
        yield
        return
    import resource

    used_bytes = int(statm.read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    before, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = [used_bytes + more_bytes, *(limit for limit in (before, hard) if limit != resource.RLIM_INFINITY)]
    resource.setrlimit(resource.RLIMIT_AS, (min(most), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (before, hard))


def _serve(answers: BinaryIO) -> None:
    jobs: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_read_jobs, args=(jobs,), daemon=True).start()
    while True:
        try:
            answer = pickle.dumps((pickle.loads(jobs.get())(), None))
        except Exception as error:
            answer = pickle.dumps((None, error))
        _send(answers, answer)


def _read_jobs(jobs: SimpleQueue[bytes]) -> None:
    with suppress(EOFError):
        while True:
            jobs.put(_receive(sys.stdin.buffer))
    os._exit(1)  # the parent has ended: one that was killed cannot end its workers


if __name__ == "__main__":
    with suppress(ModuleNotFoundError):  # Windows has none
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent handles it
    one_thread_per_library()
    with os.fdopen(os.dup(1), "wb") as stdout:
        os.dup2(2, 1)  # what a library prints is no answer
        _serve(stdout)
