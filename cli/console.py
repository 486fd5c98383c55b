"""Text and progress on the console: escaped, coloured on a terminal; bars there, lines elsewhere."""

import logging
import os
import re
import shlex
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TextIO

from mapper import __version__
from mapper.core.errors import ConfigError
from mapper.runtime.progress import SILENT, Progress, Report

_CONTROLS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # all but tab and line feed: escape sequences begin with one of these
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # those that change the direction of writing
    "\u2028\u2029\ud800-\udfff]"  # line separators; bytes of names that are no UTF-8
)
_STYLES = {"bold": "\x1b[1m", "name": "\x1b[36m", "good": "\x1b[32m", "doubt": "\x1b[33m", "bad": "\x1b[31m"}
_RESET = "\x1b[0m"
_STATES = {
    "trusted": "good",
    "yes": "good",
    "ok": "good",
    "doubtful": "doubt",
    "warn": "doubt",
    "broken in parts": "bad",
    "FAIL": "bad",
}
_STATE = re.compile(rf"^((?:verdict|trusted) +)?({'|'.join(_STATES)})(?= |$)", re.MULTILINE)
_HEADING = re.compile(r"^\S.*:$|^(?:Usage|Example):|^(?:map|look|judge|edit|study|tools)(?= )", re.MULTILINE)
_OPTION = re.compile(r"(?<=^  )-[\w-]+(?:, --?[\w-]+)*", re.MULTILINE)
_VERB = re.compile(r"^((?:map|look|judge|edit|study|tools) +| {8})([a-z]+(?:-[a-z]+)*)(?=  )", re.MULTILINE)


def escaped(text: str, *, one_line: bool = False) -> str:
    r"""Return the text with control characters as ``\x1b``; with ``one_line`` line feeds as ``\n``, too."""
    text = _CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)
    return text.replace("\n", "\\n") if one_line else text


def print_error(line: str) -> None:
    """Print a line to standard error, escaped."""
    print(escaped(line, one_line=True), file=sys.stderr)


class EscapingStream:
    """Text stream that escapes what is written to it; everything else is the wrapped stream's."""

    def __init__(self, stream: TextIO) -> None:
        self.raw = stream

    def write(self, text: str) -> int:
        """Write the text, escaped; the end of all colours, which colorama writes at exit, as it is."""
        self.raw.write(text if text == _RESET else escaped(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write the lines, escaped."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)


_LOGGED = re.compile(rb"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} \S+: mapper\b|$")  # how a log begins
_LOGGED_BYTES = 64
LOG = logging.getLogger("mapper.log-file")
"""What ``--log-file`` keeps, with times: what was asked, and all that is printed, also with ``--quiet``."""


@contextmanager
def log_kept(path: Path | None) -> Iterator[None]:
    """Append what is printed inside to a file, and what ends it.

    Raises:
        ConfigError: The file cannot be written, or is there and no log of ours.
    """
    if path is None:
        yield
        return
    try:
        if path.exists() and not (path.is_file() and _LOGGED.match(path.open("rb").read(_LOGGED_BYTES))):
            raise ConfigError(f"--log-file {path}: is there already, and is no log of mapper; name another")
        handler = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise ConfigError(f"--log-file {path}: {error.strerror}") from None
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    LOG.setLevel(logging.INFO)
    LOG.propagate = False
    LOG.addHandler(handler)
    try:
        LOG.info("%s: %s", __version__, shlex.join(["mapper", *sys.argv[1:]]))
        yield
    except BaseException as error:
        LOG.info("%s: %s", type(error).__name__, error)
        raise
    finally:
        LOG.removeHandler(handler)
        handler.close()


def print_text(text: str) -> None:
    """Print an answer; on a terminal the verdict is coloured, unless ``NO_COLOR`` is set."""
    _print(text, _coloured_state)


def print_help(text: str) -> None:
    """Print a verb's help; on a terminal headings and names are coloured, unless ``NO_COLOR`` is set."""
    _print(text, _coloured_help)


def _print(text: str, coloured: Any) -> None:
    if not has_colours(sys.stdout):
        print(text)
        return
    # What is printed to standard output is escaped, so the escape sequences of colours go past it.
    stream = getattr(sys.stdout, "raw", sys.stdout)
    stream.write(f"{coloured(escaped(text))}\n")


def has_colours(stream: TextIO) -> bool:
    """Return whether colours may be written: to a terminal that supports them, without ``NO_COLOR``."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM", "dumb") != "dumb"


def _styled(text: str, style: str) -> str:
    return f"{_STYLES[style]}{text}{_RESET}"


def _coloured_state(text: str) -> str:
    return _STATE.sub(lambda found: (found[1] or "") + _styled(found[2], _STATES[found[2]]), text)


def _coloured_help(text: str) -> str:
    text = _VERB.sub(lambda found: found[1] + _styled(found[2], "name"), text)
    text = _OPTION.sub(lambda found: _styled(found[0], "name"), text)
    return _HEADING.sub(lambda found: _styled(found[0], "bold"), text)


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


class Both:
    """Progress shown, and kept in the log file."""

    def __init__(self, shown: Progress) -> None:
        self._all = (shown, Lines(sys.maxsize, show=LOG.info))

    def note(self, message: str) -> None:
        """Print the message."""
        for one in self._all:
            one.note(message)

    @contextmanager
    def stage(self, name: str) -> Iterator[Report]:
        """Show the stage while inside."""
        with ExitStack() as stages:
            reports = [stages.enter_context(one.stage(name)) for one in self._all]

            def report_all(done: int, total: int) -> None:
                for report in reports:
                    report(done, total)

            yield report_all


def files_text(out: Path, names: Iterable[str] = (), *, width: int = 7) -> str:
    """Return what a verb has left in a folder, as two rows: the names given, or all that is there."""
    names = names or sorted(child.name for child in out.iterdir())
    return f"{'files':<{width}}{', '.join(names)}\n{'in':<{width}}{out}"


class _Notes:
    """Notes as lines, the first few only: a damaged log may have thousands."""

    def __init__(self, most_notes: int = _MOST_NOTES, *, show: Callable[[str], None] | None = None) -> None:
        self._most = most_notes
        self._seen = 0
        self._show = show or print_error

    def note(self, message: str) -> None:
        """Print the message."""
        self._seen += 1
        if self._seen <= self._most:
            self._show(f"mapper: {message}")
        elif self._seen == self._most + 1:
            self._show("mapper: … and more of these; --verbose prints all")


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
