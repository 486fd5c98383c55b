"""Progress of long jobs: stages, counts and notes, seconds per stage, and peak memory."""

import ctypes
import gc
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Protocol, runtime_checkable

Report = Callable[[int, int], None]
"""Takes how many items are done, and how many there will be."""


@runtime_checkable
class Progress(Protocol):
    """Receiver of a job's progress."""

    def stage(self, name: str) -> AbstractContextManager[Report]:
        """Enter a stage of the job, named in a word or two; the result takes its counts."""
        ...

    def note(self, message: str) -> None:
        """Receive a note of one line."""
        ...


class Silent:
    """Receiver that ignores everything."""

    @contextmanager
    def stage(self, name: str) -> Iterator[Report]:  # noqa: ARG002
        """Ignore the stage."""
        yield lambda _done, _total: None

    def note(self, message: str) -> None:
        """Ignore the message."""


SILENT = Silent()


class Stopwatch:
    """Wall seconds spent in named stages; a stage entered again adds up.

    Attributes:
        seconds: Seconds of every stage so far, in the order the stages began.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._running: dict[str, float] = {}
        self._started = time.perf_counter()

    @property
    def total_s(self) -> float:
        """Seconds since the stopwatch was made."""
        return time.perf_counter() - self._started

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time spent inside towards the stage."""
        self.seconds.setdefault(name, 0.0)
        began = self._running[name] = time.perf_counter()
        try:
            yield
        finally:
            del self._running[name]
            self.seconds[name] += time.perf_counter() - began

    def so_far(self) -> dict[str, float]:
        """Return the seconds of every stage, with those of the stages that have not ended."""
        now = time.perf_counter()
        return {name: seconds + now - self._running.get(name, now) for name, seconds in self.seconds.items()}


def forget_peak_memory() -> None:
    """Reset ``peak_memory_mb``, after freed memory was returned to the system; on Linux only."""
    gc.collect()
    with suppress(OSError, AttributeError, TypeError):  # TypeError: Windows
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # see proc(5)


def peak_memory_mb() -> float:
    """Return the largest resident memory this process has had, in megabytes of 10⁶ bytes; 0 if unknown."""
    status = Path("/proc/self/status")
    if status.exists():  # ru_maxrss also counts what the process that started us held before exec
        for line in status.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return 0.0
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest / 1e6 if sys.platform == "darwin" else largest * 1024 / 1e6
