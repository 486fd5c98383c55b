"""Answers of the verbs: one mechanism prints each as lines for people or as one JSON document."""

import functools
import inspect
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.models import OptionInfo

from mapper.cli.console import LOG, Both, log_kept, print_text, progress_for
from mapper.cli.options import refuse_several
from mapper.core.errors import LINE_WIDTH, MapperError, UntrustedError
from mapper.runtime.atomic import MANIFEST_NAME
from mapper.runtime.progress import SILENT, Progress
from mapper.runtime.result_paths import result_path

if TYPE_CHECKING:
    from mapper.run.manifest import Verdict


@dataclass(frozen=True, slots=True)
class Output:
    """Output of a verb: what it prints, by the options that every verb has.

    Attributes:
        json: One JSON document instead of lines; progress is shown on a terminal only.
        quiet: Nothing but errors.
        verbose: Every row and every note.
    """

    json: bool = False
    quiet: bool = False
    verbose: bool = False

    def progress(self, *, prompts: bool = False) -> Progress:
        """Return the progress of a job, on stderr; bars would overdraw prompts."""
        quiet = self.quiet or (self.json and not sys.stderr.isatty())
        shown = progress_for(quiet=quiet, prompts=prompts, every_note=self.verbose)
        return Both(shown) if LOG.handlers else shown

    @contextmanager
    def waiting(self, name: str) -> Iterator[None]:
        """Show, on a terminal, that something of which no part can be counted goes on."""
        progress = self.progress() if sys.stderr.isatty() else SILENT
        with progress.stage(name) as report:
            yield
            report(1, 1)


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Answer of a verb: what it made or found.

    Attributes:
        document: Document of ``--json``; keys are stable and end in the unit: ``total_s``, ``path_length_m``.
        text: Lines for people.
        details: Text of ``--verbose``; empty if that is ``text``.
        error: Raised after printing: the answer is whole, but the exit status is 1.
    """

    document: Mapping[str, Any] = field(default_factory=dict)
    text: str = ""
    details: str = ""
    error: MapperError | None = None


def untrusted(path: Path, verdict: "Verdict") -> UntrustedError | None:
    """Return the error of ``--strict`` about what a verb has written; None if its verdict is "trusted"."""
    if verdict.state == "trusted":
        return None
    return UntrustedError(f"{path}: {verdict.state}: {verdict.sentences[0]}")


def made(path: Path, **more: object) -> Answer:
    """Return the answer of a verb that writes one file or folder: its path."""
    return Answer({"path": path, **more}, str(path))


def record_in(folder: Path, name: str = MANIFEST_NAME) -> dict[str, Any]:
    """Return the folder's path and the content of the JSON file in it."""
    return {"path": folder, **json.loads((folder / name).read_bytes())}


def verb(function: Callable[..., Answer]) -> Callable[..., None]:
    """Return a command with the options of every verb, which prints the function's answer.

    The function takes its :class:`Output` as the keyword ``output``.
    """

    @functools.wraps(function)
    def command(*, json: bool, verbose: bool, quiet: bool, log_file: Path | None, **given: Any) -> None:
        output = Output(json=json, quiet=quiet, verbose=verbose)
        with log_kept(log_file):
            try:
                refuse_several({"--verbose": verbose, "--quiet": quiet})
                for name in _RESULTS & given.keys():
                    given[name] = None if given[name] is None else result_path(given[name])
                answer = function(**given, output=output)
            except Exception as error:
                if json:
                    print_json(error_document(type(error).__name__, str(error)))
                raise
            _show(answer, output)
            if answer.error is not None:
                raise answer.error

    own = [p for p in inspect.signature(function).parameters.values() if p.name != "output"]
    for parameter in own:
        if parameter.name == "out" and isinstance(option := parameter.annotation.__metadata__[0], OptionInfo):
            option.param_decls = ("--out", "-o")
    own = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in own]
    options = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        for name, (annotation, default) in _COMMON.items()
    ]
    command.__signature__ = inspect.Signature([*own, *options])  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in (*own, *options)}
    del command.__wrapped__
    return command


_RESULTS = frozenset({"out", "plot"})
"""Parameters of verbs that name what they write."""
_COMMON: dict[str, tuple[Any, bool | None]] = {
    "json": (
        Annotated[bool, typer.Option("--json", help="Print one JSON document, also of an error.")],
        False,
    ),
    "verbose": (
        Annotated[bool, typer.Option("--verbose", "-v", help="Print every row and every note.")],
        False,
    ),
    "quiet": (Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")], False),
    "log_file": (
        Annotated[Path | None, typer.Option(help="File that what is printed is appended to, with times.")],
        None,
    ),
}


def _show(answer: Answer, output: Output) -> None:
    text = (output.verbose and answer.details) or answer.text
    for line in text.splitlines():
        LOG.info(line)
    if output.quiet:
        return
    if output.json:
        print_json(answer.document)
    elif text:
        print_text(text)


def print_json(document: Mapping[str, Any]) -> None:
    """Print a document of ``--json``."""
    print(json.dumps(plain(document), indent=2, ensure_ascii=False, allow_nan=False))


def error_document(kind: str, message: str) -> dict[str, Any]:
    """Return the document of an error: its class, and its line."""
    return {"error": {"kind": kind, "message": message}}


def plain(value: Any) -> Any:
    """Return a value as JSON has it: numbers that are not finite are null."""
    from pydantic_core import to_jsonable_python

    def other(value: Any) -> Any:
        if isinstance(value, Mapping):
            return dict(value)
        return value.tolist() if hasattr(value, "tolist") else list(value)

    return to_jsonable_python(value, inf_nan_mode="null", fallback=other)


def rows_text(rows: Sequence[tuple[str, str]], *, width: int | None = None) -> str:
    """Return aligned lines of name and text; what does not fit, on the terminal too, is wrapped below."""
    from shutil import get_terminal_size
    from textwrap import wrap

    if width is None:
        width = min(LINE_WIDTH, get_terminal_size().columns) if sys.stdout.isatty() else LINE_WIDTH
    indent = 2 + max(len(name) for name, _ in rows)
    lines = []
    for name, text in rows:
        folded = wrap(text, max(width - indent, 20), break_long_words=False, break_on_hyphens=False) or [""]
        lines += [f"{name:<{indent}}{folded[0]}", *(" " * indent + line for line in folded[1:])]
    return "\n".join(lines)
