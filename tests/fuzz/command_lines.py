"""Command lines: every verb with drawn options, hostile paths and hostile files, in a folder of its own."""

import os
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from threading import Event, Thread
from typing import Any, Literal, get_args, get_origin

import numpy as np
import typer
from hypothesis import strategies as st

from mapper.cli.main import app
from tests.fuzz.damage import KINDS, damage
from tests.fuzz.runner import SECOND_LIMIT_S, Reading, Runner

LINE = "line"
"""Word of ``tests.fuzz.child`` before the folder that a command line is run in, and before the line."""

_RESULTS = ("--out", "--plot", "--rrd")
_LOG_FILE = "--log-file"
"""Option that appends to a file whatever comes of the line; to one that is empty, or a log of ours."""
_EMPTY = sha256(b"").hexdigest()
_UNUSED = ("--page", "--spawn", "--connect", "--step", "--scheduler", "--rerun", "--warm")
"""Options that open viewers, wait for a person or for another machine, or compile all kernels."""
_BRIEF = {
    "demo": ("--seconds", "0.2"),
    "synth": ("--seconds", "0.1"),
    "line-laser-accuracy": ("--seeds", "0"),
    "compare": ("--pairs", "0"),
    "doctor": ("run",),
}
"""Words without which a verb has a minute of work, whatever else it is given."""
_LEFT = {"demo": "/log"}
"""What a verb leaves when it is refused, beside what is not whole and named so."""
_INPUTS = (
    *("run", "log", "run/graph.g2o", "run/trajectory.tum", "run/manifest.json", "run/map.octree"),
    *("run/config.json", "log/rgb.txt", "log/groundtruth.txt", "log/rgb", "log/calibration.toml"),
)
_HOSTILE = (
    *("", " ", ".", "..", "./", "/", "~", "-", "--", "-1", "*", "%s", "{}", "a\nb", "\x1b[2J", "é\u202e"),
    *("\udcff",),
    *("a" * 300, "a/" * 300, "a/../../b", "run/../run", "run/", "log/..", "../outside"),
    *("../outside/kept.txt",),
    *("absent", "absent/deeper/still", "notes.txt", "notes.txt/below", "empty", "empty.bag", "random.mcap"),
    *("random.db3", "random.toml", "random.json", "random.g2o", "random.ply", "random.npy", "a.partial"),
    *("pipe", "loop", "dangling", "out-of-it", "/dev/null", "/dev/full", "/dev/zero", "/proc/self/mem"),
)
_NUMBERS = (
    *("0", "1", "-1", "2", "0.5", "1e-300", "1e400", "nan", "inf", "-inf", "", "x", "1_0", "٣"),
    *("99999999999",),
)
_TEXTS = (
    *("", "x", "=", "a=b", "a.a.a=1", "." * 99, "odometry.kind=isvd", "octree.voxel_m=0"),
    *("octree.voxel_m=1e300",),
    *("source.stride=0", "source.rate_hz=nan", "=1", "odometry=1", "0,0", "0,0,1", "1,2,3,4,5,6", "nan,0,0"),
    *("all", "none", "ply", "octomap", "grid", "tum", "gicp", "icp", "0:1", "1", "-1", "a\nb", "\x00x"[1:]),
    *("ü" * 999,),
)


@dataclass(frozen=True)
class Verb:
    """A verb of the program: its words, and its arguments and options as Typer has them."""

    words: tuple[str, ...]
    parameters: tuple[Any, ...]


def every_verb() -> Iterator[Verb]:
    """Yield every verb that the program has, those of its groups too."""

    def below(command: Any, words: tuple[str, ...]) -> Iterator[Verb]:
        if not (commands := getattr(command, "commands", None)):
            yield Verb(words, tuple(command.params))
            return
        for name, child in commands.items():
            yield from below(child, (*words, name))

    return below(typer.main.get_command(app), ())


@dataclass(frozen=True)
class Line:
    """A command line, and the damage to the files that it may name.

    Attributes:
        verb: Words of its verb.
        words: Arguments and options.
        damages: Kinds of damage, each to a file of its own choice.
        seed: Of the damage.
    """

    verb: tuple[str, ...]
    words: tuple[str, ...]
    damages: tuple[str, ...]
    seed: int

    @property
    def results(self) -> tuple[str, ...]:
        """What it says is to be written."""
        return (*self._after(*_RESULTS), *(self.words if self.verb == ("synth",) else ()))

    @property
    def log_files(self) -> list[str]:
        """What it says is to be appended to."""
        return self._after(_LOG_FILE)

    def _after(self, *options: str) -> list[str]:
        return [word for one, word in zip(self.words, self.words[1:], strict=False) if one in options]


def lines(*, brief: bool = False) -> st.SearchStrategy[Line]:
    """Return Hypothesis's strategy of command lines: any verb, with few options more than it needs.

    Args:
        brief: Leave out the verbs that work for seconds whatever they are given.
    """
    damages = st.one_of(st.just(()), st.tuples(st.sampled_from(KINDS)))
    verbs = [verb for verb in every_verb() if not (brief and verb.words[-1] in _BRIEF)]
    return st.sampled_from(verbs).flatmap(
        lambda verb: st.builds(
            Line, st.just(verb.words), _words(verb), damages, st.integers(0, (1 << 32) - 1)
        )
    )


@st.composite
def _words(draw: st.DrawFn, verb: Verb) -> tuple[str, ...]:
    words = list(_BRIEF.get(verb.words[-1], ()))
    optional = [p for p in verb.parameters if not p.required and not {p.opts[0], p.name} & {*_UNUSED, *words}]
    chosen = draw(st.lists(st.sampled_from(optional), max_size=3, unique_by=lambda p: str(p.name)))
    for parameter in [*(p for p in verb.parameters if p.required), *chosen]:
        is_option = parameter.opts[0].startswith("-")
        for _ in range(draw(st.sampled_from([1, 1, 1, 2])) if parameter.nargs == -1 else 1):
            values = draw(_values(parameter))
            if is_option or values[0][:1] != "-":
                words += [parameter.opts[0], *values] if is_option else values
    return tuple(words)


def _values(parameter: Any) -> st.SearchStrategy[list[str]]:
    """Return the strategy of the words that follow an option, or stand for an argument."""
    kind = _kind_of(parameter)
    if getattr(parameter, "is_flag", False):
        return st.just([])
    if get_origin(kind) is Literal:
        return st.lists(st.sampled_from([*get_args(kind), "x"]), min_size=1, max_size=1)
    if get_origin(kind) is list:
        (kind,) = get_args(kind)
    if kind is Path:
        # A path of an input is as often a good one; what is written goes anywhere.
        good = [] if parameter.opts[0] in _RESULTS else _INPUTS
        word = (
            st.sampled_from(_HOSTILE)
            if not good
            else st.one_of(st.sampled_from(good), st.sampled_from(_HOSTILE))
        )
    else:
        word = st.sampled_from((*_TEXTS, *_INPUTS) if kind is str else _NUMBERS)
    return st.lists(word, min_size=max(parameter.nargs, 1), max_size=max(parameter.nargs, 1))


def _kind_of(parameter: Any) -> Any:
    """Return a parameter's annotation, by typer 0.28 and later or by those before, which rko-lio asks for."""
    if hasattr(parameter, "type_descriptor"):
        return parameter.type_descriptor.annotation
    if choices := getattr(parameter.type, "choices", None):
        return Literal[tuple(choices)]
    return {"path": Path, "str": str}.get(parameter.type.name, float)


class Sandbox:
    """Folder in which command lines are run: ``work`` with what they may name, and ``outside`` beside it."""

    def __init__(self, scratch: Path, runner: Runner) -> None:
        self._folder, self._model, self._child = scratch / "box", scratch / "model", runner
        work = self._model / "work"
        runner.corpus.copy("run", work)  # with the log that it is built of
        (work / "notes.txt").write_text("nothing of ours\n")
        (work / "empty").mkdir()
        rng = np.random.default_rng(0)
        for ending in ("mcap", "db3", "toml", "json", "g2o", "ply", "npy"):
            (work / f"random.{ending}").write_bytes(rng.bytes(2000))
        (work / "empty.bag").touch()
        (work / "a.partial").mkdir()
        (work / "a.partial" / "kept.txt").write_text("kept\n")
        (self._model / "outside").mkdir()
        (self._model / "outside" / "kept.txt").write_text("kept\n")
        for name, target in (("loop", "loop"), ("dangling", "nowhere"), ("out-of-it", "../outside")):
            (work / name).symlink_to(target)
        os.mkfifo(work / "pipe")

    def run(self, line: Line) -> Reading:
        """Run a command line in a fresh copy, and return the outcome; an "error" is one against the rules."""
        shutil.rmtree(self._folder, ignore_errors=True)
        _copy(self._model, self._folder)
        rng, work = np.random.default_rng(line.seed), self._folder / "work"
        file = ", ".join(f"{damage(work, kind, rng)} ({kind})" for kind in line.damages)
        before = _content(self._folder)
        with _written(work / "pipe"):
            reading = self._child.ask([LINE, str(work), *line.verb, *line.words], limit_s=SECOND_LIMIT_S)
        if not reading.is_fault and (broken := self._broken_rule(line, reading, before)):
            reading = Reading("error", f"{broken}; {reading.outcome}: {reading.detail}")
        return replace(reading, file=file, command=repr([*line.verb, *line.words]))

    def _broken_rule(self, line: Line, reading: Reading, before: Mapping[str, str]) -> str:
        """Return what a line has changed that it must not; empty if there is nothing."""
        after = _content(self._folder)
        logs = [*map(_within(self._folder), line.log_files)]
        kept = {name: what for name, what in before.items() if what != _EMPTY or name not in logs}
        lost = [name for name, what in kept.items() if after.get(name) != what]
        new = [name for name in after if name not in before and name not in logs]
        if reading.outcome == "refused":
            # A folder that is not whole stays for inspection, or to be resumed.
            left = [name for name in new if ".partial" in name or _LEFT.get(line.verb[0], ".partial") in name]
            new = [name for name in new if not any(_lies_in(one, name) for one in left)]
            return f"refused, but lost {lost[:3]}" if lost else f"refused, but wrote {new[:3]}" if new else ""
        named = [os.path.normpath(f"work/{word}") for word in line.words]
        lost = [name for name in lost if not any(_lies_in(name, one) for one in named)]
        results = [*map(_within(self._folder), line.results), "work"]
        new = [name for name in new if not any(_lies_in(name, one) for one in results)]
        return f"lost {lost[:3]}" if lost else f"wrote {new[:3]}" if new else ""


@contextmanager
def _written(pipe: Path) -> Iterator[None]:
    """Write nothing into a pipe whenever it is read; a verb that it is named to as a text waits for that."""
    done = Event()

    def write() -> None:
        while not done.wait(0.05):
            with suppress(OSError):  # nobody reads it
                os.close(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))

    writer = Thread(target=write)
    writer.start()
    try:
        yield
    finally:
        done.set()
        writer.join()


def _within(folder: Path) -> Any:
    return lambda word: os.path.relpath(os.path.realpath(folder / "work" / word), os.path.realpath(folder))


def _lies_in(name: str, folder: str) -> bool:
    return name == folder or name.startswith(f"{folder}/")


def _copy(model: Path, folder: Path) -> None:
    """Copy a folder with its links and pipes."""
    for parent, folders, files in os.walk(model):
        to = folder / Path(parent).relative_to(model)
        to.mkdir(parents=True)
        for name in (*folders, *files):
            path = Path(parent) / name
            if path.is_symlink():
                (to / name).symlink_to(path.readlink())
            elif stat.S_ISFIFO(path.lstat().st_mode):
                os.mkfifo(to / name)
            elif path.is_file():
                shutil.copyfile(path, to / name)


def _content(folder: Path) -> dict[str, str]:
    """Return what is at every path below a folder."""
    content = {}
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(parent) / name
            status = path.lstat()
            what = oct(stat.S_IFMT(status.st_mode))
            if path.is_symlink():
                what = str(path.readlink())
            elif stat.S_ISREG(status.st_mode):
                small = status.st_size < 1 << 24
                what = sha256(path.read_bytes()).hexdigest() if small else str(status.st_size)
            content[str(path.relative_to(folder))] = what
    return content
