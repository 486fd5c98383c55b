"""Jobs for workers in other processes, which import them by name; what they do is counted in a file."""

import os
import pickle
import signal
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.runtime.executor import run_jobs


def told(diary: Path) -> Counter[str]:
    """Number of times that each job was begun."""
    return Counter(diary.read_text().split()) if diary.exists() else Counter()


@dataclass(frozen=True)
class Work:
    """Note in the diary that it was begun, then do as the name says."""

    diary: Path
    name: str
    how: str = "square"

    def __call__(self) -> object:
        began_before = told(self.diary)[self.name]
        with self.diary.open("a") as stream:
            stream.write(f"{self.name}\n")  # one write of a few bytes: nobody else's comes between
        return getattr(self, f"_{self.how}")(began_before)

    def _square(self, _before: int) -> int:
        return int(self.name) ** 2

    def _wait(self, _before: int) -> None:
        (self.diary.parent / f"{self.name}.pid").write_text(str(os.getpid()))
        time.sleep(60.0)

    def _raise(self, _before: int) -> None:
        raise ValueError(f"no such\nthing as {self.name}")

    def _refuse(self, _before: int) -> None:
        raise SourceError(f"{self.name}.png: is black")

    def _exit(self, _before: int) -> None:
        os._exit(3)

    def _kill(self, _before: int) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def _exit_once(self, before: int) -> int:
        return 7 if before else os._exit(1)

    def _unpicklable(self, _before: int) -> object:
        return lambda: 0

    def _limits(self, _before: int) -> tuple[int, str]:
        import cv2

        return cv2.getNumThreads(), os.environ["OMP_NUM_THREADS"]

    def _records(self, _before: int) -> list[dict[str, object]]:
        return [{"name": self.name, "third": int(self.name) / 3, "nothing": None}]

    def _nap_records(self, _before: int) -> list[dict[str, object]]:
        time.sleep(0.3)
        return [{"name": self.name}]

    def _nan(self, _before: int) -> list[dict[str, float]]:
        return [{"ratio": float("nan")}]


def run_elsewhere(jobs: list, executor: object, **options: object) -> Iterator[tuple[int, object]]:
    """Run jobs as other processes get them: pickled, and in another order."""
    order = np.random.default_rng(0).permutation(len(jobs)).tolist()
    copies = [pickle.loads(pickle.dumps(jobs[i])) for i in order]
    for index, result in run_jobs(copies, executor, **options):
        yield order[index], pickle.loads(pickle.dumps(result))


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def until(holds: object, *, seconds: float = 30.0) -> None:
    """Wait until something is so."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)
