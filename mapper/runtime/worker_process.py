"""Worker process: runs jobs one at a time in a process of its own; how it ended, and how a job failed."""

import os
import pickle
import signal
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from mapper.core.errors import MapperError
from mapper.runtime.threads import one_thread_per_library

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
