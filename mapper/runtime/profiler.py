"""Profile of a job: the time of each stage's items, and samples of all threads for speedscope."""

import json
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median, quantiles
from types import FrameType, TracebackType
from typing import Any, Self

from mapper.runtime.atomic import write_text
from mapper.runtime.progress import Progress, Report

_PERIOD_S = 0.01
_MOST_SAMPLES = 200_000
"""The period doubles each time this number more are kept: 30 MB."""
_SCHEMA = "https://www.speedscope.app/file-format-schema.json"
_WAITING = ("threading.py", "queue.py", "concurrent/futures/thread.py", "concurrent/futures/_base.py")
"""Files whose functions wait for other threads when they are innermost."""

_Place = tuple[str, str, int]  # function, file, its first line
_Stack = tuple[int, ...]


class Profiler:
    """Profiler of the process while it is entered, and a job's progress that times each stage's items.

    Another thread looks at all others a hundred times a second (1 % of a core). Compiled code counts towards
    the line that calls it; threads that wait are left out.
    """

    def __init__(self, progress: Progress) -> None:
        """Begin without samples; ``progress`` receives all that this one does."""
        self._progress = progress
        self._places: dict[_Place, int] = {}
        self._stacks: dict[_Stack, _Stack] = {}
        self._samples: dict[str, list[tuple[_Stack, float]]] = defaultdict(list)
        self._item_s: dict[str, list[float]] = defaultdict(list)
        self._ended = threading.Event()
        self._sampler = threading.Thread(target=self._sample, name="profiler", daemon=True)

    def __enter__(self) -> Self:
        self._sampler.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._sampler.join()

    @contextmanager
    def stage(self, name: str) -> Iterator[Report]:
        """Enter a stage; each report ends an item of it."""
        with self._progress.stage(name) as report:
            item_s, last_s = self._item_s[name], time.perf_counter()

            def timed(done: int, total: int) -> None:
                nonlocal last_s
                now_s = time.perf_counter()
                item_s.append(now_s - last_s)
                last_s = now_s
                report(done, total)

            yield timed

    def note(self, message: str) -> None:
        """Pass a note on."""
        self._progress.note(message)

    def stages(self) -> dict[str, dict[str, float]]:
        """Return, by stage, its items, their seconds in all, and the median and 95th percentile in ms."""
        return {
            name: {
                "items": len(item_s),
                "total_s": sum(item_s),
                "median_ms": 1e3 * median(item_s),
                "p95_ms": 1e3 * (quantiles(item_s, n=20)[-1] if len(item_s) > 1 else item_s[0]),
            }
            for name, item_s in self._item_s.items()
            if item_s
        }

    def write(self, path: Path, *, name: str) -> None:
        """Write the samples as a file of speedscope (https://www.speedscope.app), a profile for each thread.

        Args:
            path: The file, replaced if there is one.
            name: Title of the profile.

        Raises:
            WriteError: It cannot be written.
        """
        frames = [{"name": what, "file": file, "line": line} for what, file, line in self._places]
        tree = {"$schema": _SCHEMA, "name": name, "shared": {"frames": frames}, "profiles": self._profiles()}
        write_text(path, json.dumps(tree, separators=(",", ":")))

    def _profiles(self) -> list[dict[str, Any]]:
        """Return a profile of each thread, the busiest first."""
        profiles = []
        for thread, samples in self._samples.items():
            weights = [seconds for _, seconds in samples]
            stacks = [list(stack) for stack, _ in samples]
            profile = {"type": "sampled", "name": thread, "unit": "seconds", "startValue": 0.0}
            profiles.append({**profile, "endValue": sum(weights), "samples": stacks, "weights": weights})
        return sorted(profiles, key=lambda profile: -profile["endValue"])

    def _sample(self) -> None:
        last_s, period_s = time.perf_counter(), _PERIOD_S
        while not self._ended.wait(period_s):
            now_s = time.perf_counter()
            elapsed_s, last_s = now_s - last_s, now_s
            names = {thread.ident: thread.name for thread in threading.enumerate()}
            for ident, frame in sys._current_frames().items():
                if ident != self._sampler.ident and not frame.f_code.co_filename.endswith(_WAITING):
                    self._add(names.get(ident, f"{ident}"), self._stack(frame), elapsed_s)
            kept = sum(map(len, self._samples.values()))
            period_s = _PERIOD_S * 2 ** (kept // _MOST_SAMPLES)

    def _add(self, thread: str, stack: _Stack, elapsed_s: float) -> None:
        """Add a sample, to the last one where that has the same stack."""
        samples = self._samples[thread]
        if samples and samples[-1][0] == stack:
            samples[-1] = stack, samples[-1][1] + elapsed_s
        else:
            samples.append((stack, elapsed_s))

    def _stack(self, frame: FrameType | None) -> _Stack:
        """Return the numbers of the functions, from the outermost to the innermost."""
        stack: list[int] = []
        while frame is not None:
            code = frame.f_code
            place = code.co_qualname, code.co_filename, code.co_firstlineno
            stack.append(self._places.setdefault(place, len(self._places)))
            frame = frame.f_back
        found = tuple(reversed(stack))
        return self._stacks.setdefault(found, found)
