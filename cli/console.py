"""Progress and results on the console: bars on a terminal, lines elsewhere, both on stderr."""

import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from mapper.cli.terminal import escaped
from mapper.runtime.progress import SILENT, Progress, Report

_SECONDS_BETWEEN_LINES = 10.0
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
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (
            TextColumn("{task.description:<7}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(elapsed_when_finished=True),
        )
        # Bars are drawn by escape sequences, which text may not have.
        terminal = getattr(sys.stderr, "raw", sys.stderr)
        with Progress(*columns, console=Console(file=terminal)) as bars:
            task = bars.add_task(name, total=None, rate="")
            began = time.monotonic()

            def report(done: int, total: int) -> None:
                rate = done / max(time.monotonic() - began, 1e-3)
                bars.update(task, completed=done, total=total, rate=_rate_text(rate))

            yield report


class Lines(_Notes):
    """A line at the end of each stage, and every ten seconds before."""

    @contextmanager
    def stage(self, name: str) -> Iterator[Report]:
        """Print how far it is while inside."""
        began = said = time.monotonic()
        reached = (0, 0)

        def report(done: int, total: int) -> None:
            nonlocal said, reached
            reached = done, total
            now = time.monotonic()
            if now - said > _SECONDS_BETWEEN_LINES and 0 < done < total:
                said = now
                rate = done / (now - began)
                self._show(f"{name}: {done}/{total}, {_rate_text(rate)}, {(total - done) / rate:.0f} s left")

        yield report
        self._show(f"{name}: {reached[0]}/{reached[1]} in {time.monotonic() - began:.1f} s")


def _rate_text(per_s: float) -> str:
    return f"{per_s:.0f}/s" if per_s >= 10.0 else f"{per_s:.1f}/s"
