"""Progress and results on the console: bars on a terminal, lines elsewhere, both on stderr."""

import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from mapper.cli.terminal import escaped
from mapper.runtime.progress import SILENT, Progress, Report

_SECONDS_BETWEEN_LINES = 10.0
_FEWEST_DONE = 5
"""Items, by whose time that of the others is estimated."""
_MOST_NOTES = 5


def progress_for(*, quiet: bool, prompts: bool = False, every_note: bool = False) -> Progress:
    """Return the progress of a job: silent, bars on a terminal, or lines; bars would overdraw prompts."""
    if quiet:
        return SILENT
    most_notes = sys.maxsize if every_note else _MOST_NOTES
    return Bars(most_notes) if sys.stderr.isatty() and not prompts else Lines(most_notes)


def files_text(out: Path, names: Iterable[str] = (), *, width: int = 7) -> str:
    """Return what a verb has left in a folder, as two rows: the names given, or all that is there."""
    names = names or sorted(child.name for child in out.iterdir())
    return f"{'files':<{width}}{', '.join(names)}\n{'in':<{width}}{out}"


class _Notes:
    """Notes as lines, the first few only: a damaged log may have thousands."""

    def __init__(self, most_notes: int = _MOST_NOTES) -> None:
        self._most = most_notes
        self._seen = 0

    def note(self, message: str) -> None:
        """Print the message."""
        self._seen += 1
        if self._seen <= self._most:
            self._show(f"mapper: {message}")
        elif self._seen == self._most + 1:
            self._show("mapper: … and more of these; --verbose prints all")

    def _show(self, line: str) -> None:
        print(escaped(line, one_line=True), file=sys.stderr)


class Bars(_Notes):
    """One progress bar per stage, with the rate and the time left."""

    @contextmanager
    def stage(self, name: str) -> Iterator[Report]:
        """Show the bar while inside."""
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (
            TextColumn("{task.description:<7}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TextColumn("{task.fields[left]}"),
            TimeElapsedColumn(),
        )
        # Bars are drawn by escape sequences, which text may not have.
        terminal = getattr(sys.stderr, "raw", sys.stderr)
        with Progress(*columns, console=Console(file=terminal)) as bars:
            task = bars.add_task(name, total=None, rate="", left="")
            pace = _Pace()

            def report(done: int, total: int) -> None:
                rate = pace.rate(done)
                left = _left_text(rate, total - done) if done < total else ""
                bars.update(task, completed=done, total=total, rate=_rate_text(rate), left=left)

            yield report


class Lines(_Notes):
    """A line at the end of each stage, and every ten seconds before."""

    @contextmanager
    def stage(self, name: str) -> Iterator[Report]:
        """Print how far it is while inside."""
        began = said = time.monotonic()
        reached, pace = (0, 0), _Pace()

        def report(done: int, total: int) -> None:
            nonlocal said, reached
            reached = done, total
            now, rate = time.monotonic(), pace.rate(done)
            if now - said > _SECONDS_BETWEEN_LINES and 0 < done < total:
                said = now
                parts = [f"{done}/{total}", _rate_text(rate), _left_text(rate, total - done)]
                self._show(f"{name}: {', '.join(text for text in parts if text)}")

        yield report
        self._show(f"{name}: {reached[0]}/{reached[1]} in {time.monotonic() - began:.1f} s")


class _Pace:
    """Rate of a stage, over the later half of its time: the first items may wait for compilers and caches."""

    def __init__(self) -> None:
        self._reports = deque([(time.monotonic(), 0)])
        self._began = self._reports[0][0]

    def rate(self, done: int) -> float | None:
        """Return items per second by now; None while too few are done to tell."""
        now = time.monotonic()
        self._reports.append((now, done))
        while self._reports[0][0] < (self._began + now) / 2:
            self._reports.popleft()
        then, before = self._reports[0]
        return (done - before) / max(now - then, 1e-3) if done - before >= _FEWEST_DONE else None


def _rate_text(per_s: float | None) -> str:
    if per_s is None:
        return ""
    return f"{per_s:.0f}/s" if per_s >= 10.0 else f"{per_s:.1f}/s"


def _left_text(per_s: float | None, left: int) -> str:
    return "" if per_s is None else f"{left / per_s:.0f} s left"
