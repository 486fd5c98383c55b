"""Isolated calls: libraries that abort on damaged input run in a process of their own, in bounded memory.

``python -m mapper.runtime.isolated`` is that process: it takes pickled jobs on its standard input. Unlike
:mod:`mapper.runtime.executor` it does not import the main module again, which a script that only reads
a file need not allow for, and may be started by a worker.
"""

import atexit
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, TypeVar, cast

from mapper.core.errors import DataError

R = TypeVar("R")

_idle: list["_Child"] = []


def call_isolated(job: Callable[[], R], *, memory_bytes: int) -> R:
    """Return what a job returns, or raise what it raises; the process that ran it is kept for later calls.

    Args:
        job: A callable that can be pickled, as its result and exceptions can.
        memory_bytes: Limit of what it may allocate (Linux).

    Raises:
        DataError: The process ended; the message says how.
    """
    try:
        child = _idle.pop()
    except IndexError:  # all are busy: one for each thread
        child = _Child()
    try:
        result, error = child.call((job, memory_bytes))
    except BaseException:
        child.kill()
        raise
    _idle.append(child)
    if error is not None:
        raise error
    return cast("R", result)


class _Child:
    def __init__(self) -> None:
        paths = os.pathsep.join(filter(None, sys.path))
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            env=os.environ | {"PYTHONPATH": paths},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # a library that aborts prints its stack
        )

    def call(self, work: tuple[Callable[[], R], int]) -> tuple[R | None, Exception | None]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            pickle.dump(work, self._process.stdin)
            self._process.stdin.flush()
            result, error = pickle.load(self._process.stdout)
        except (BrokenPipeError, EOFError, pickle.UnpicklingError):
            code = self._process.wait()
            how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
            raise DataError(f"the process that reads it {how}") from None
        return result, error

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()


@atexit.register
def _kill_idle() -> None:
    while _idle:
        _idle.pop().kill()


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


def _serve(jobs: BinaryIO, answers: BinaryIO) -> None:
    while True:
        try:
            job, memory_bytes = pickle.load(jobs)
        except EOFError:  # the parent ended
            return
        answer: tuple[Any, Exception | None]
        try:
            with memory_limited(memory_bytes):
                answer = job(), None
        except Exception as error:
            answer = None, error
        pickle.dump(answer, answers)
        answers.flush()


if __name__ == "__main__":
    with suppress(ModuleNotFoundError):  # Windows has none
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent handles it
    with os.fdopen(os.dup(1), "wb") as stdout:
        os.dup2(2, 1)  # what a library prints is no answer
        _serve(sys.stdin.buffer, stdout)
