"""The command line: its verbs, and the one place that turns an error into a line and an exit status."""

import errno
import gc
import os
import sys
import warnings
from collections.abc import Callable
from typing import Annotated, Any, Literal, TextIO

import typer

from mapper import __version__
from mapper.cli import completion
from mapper.cli.answer import Answer, verb
from mapper.cli.build import build, demo, fuse
from mapper.cli.console import LOG, EscapingStream, print_error
from mapper.cli.convert import convert, export
from mapper.cli.diff import diff
from mapper.cli.doctor import doctor
from mapper.cli.edit import edit
from mapper.cli.environment import handle_interrupts, prepare_environment
from mapper.cli.evaluate import evaluate
from mapper.cli.groups import HELP, Verb, VerbGroup, show_help
from mapper.cli.inspect import inspect
from mapper.cli.localise import localise
from mapper.cli.loops import WithPairs, loops
from mapper.cli.merge import merge
from mapper.cli.plan import WithPoints, plan
from mapper.cli.register import register
from mapper.cli.sensor import sensor
from mapper.cli.show_config import show_config
from mapper.cli.solve import solve
from mapper.cli.studies import compare, reproduce, sweep
from mapper.cli.synth import synth
from mapper.cli.view import report, view
from mapper.cli.vocabulary import vocabulary
from mapper.core.errors import MapperError, MapperWarning, Terminated

_INTERRUPTED, _TERMINATED = 130, 143  # 128 + SIGINT, 128 + SIGTERM, as shells count
_COLLECT_AFTER = 50_000
"""New objects after which Python searches for cycles: at its own 700 this takes 6 to 12 % of a build: the
libraries leave a million objects to search, and our data have no cycles."""
_USER_CAN_HELP = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES, errno.EPERM, errno.EROFS}
_USER_CAN_HELP |= {errno.ENAMETOOLONG, errno.ELOOP}


class Guarded(VerbGroup):
    """Turns a user's mistake into one line; a bug keeps its traceback."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Take ``help VERB`` and ``version`` as the options of these names."""
        match args:
            case ["help", *verbs]:
                args = [*verbs, "--help"]
            case ["version"]:
                args = ["--version"]
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> object:
        """Run the verb."""
        try:
            return super().invoke(ctx)
        except MapperError as error:
            _say(str(error), error)
            raise typer.Exit(1) from None
        except OSError as error:
            if error.errno not in _USER_CAN_HELP:
                raise
            _say(f"{error.filename2 or error.filename or 'a file'}: {error.strerror}", error)
            raise typer.Exit(1) from None
        except MemoryError as error:
            _say("the memory does not suffice; close other programs, or read less of the log", error)
            raise typer.Exit(1) from None
        except Terminated as error:
            _say("ended by SIGTERM", error)
            raise typer.Exit(_TERMINATED) from None
        except KeyboardInterrupt as error:
            _say("interrupted", error)
            raise typer.Exit(_INTERRUPTED) from None


def _say(what: str, error: BaseException) -> None:
    line = "; ".join([f"mapper: {what}", *getattr(error, "__notes__", ())])
    print_error(line)


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    if issubclass(category, MapperWarning):
        print_error(f"mapper: {message}")
        LOG.info(f"mapper: {message}")
    else:
        _python_shows_warning(message, category, filename, lineno, file, line)


_python_shows_warning = warnings.showwarning

_VERBS: dict[str, list[tuple[str, Callable[..., Answer], type[Verb], str]]] = {
    "map": [
        ("build", build, Verb, "Map a recorded log: path, pose graph, octree, 2D slice"),
        ("demo", demo, Verb, "Make a synthetic log and map it"),
        ("fuse", fuse, Verb, "Make a run's maps again, finer or along other poses"),
        ("localise", localise, Verb, "Place a new log in a finished map"),
        ("merge", merge, Verb, "Join the maps of many runs"),
        ("solve", solve, Verb, "Solve a pose graph from a g2o file"),
    ],
    "look": [
        ("view", view, Verb, "Show a run in 3D, in a browser or in Rerun"),
        ("report", report, Verb, "Write one page about runs, side by side"),
        ("export", export, Verb, "Write a run's map, cloud, path … for other programs"),
        ("plan", plan, WithPoints, "Plan a robot's path through a map"),
    ],
    "judge": [
        ("eval", evaluate, Verb, "Measure the errors of a path and a map"),
        ("diff", diff, Verb, "Show what changed between two runs"),
        ("inspect", inspect, Verb, "Show what is in a log, and whether it can be mapped"),
        ("doctor", doctor, Verb, "Check this machine, or the files of a run"),
    ],
    "edit": [
        ("edit", edit, Verb, "Erase, keep or block regions of a map"),
        ("loops", loops, WithPairs, "List loop closures, add and remove them"),
    ],
    "study": [
        ("compare", compare, Verb, "Run every method on one log"),
        ("register", register, Verb, "Align two clouds or frames"),
        ("sweep", sweep, Verb, "Run many logs by many settings"),
        ("reproduce", reproduce, Verb, "Measure the papers' tables again"),
    ],
    "tools": [
        ("config", show_config, Verb, "Print and explain the settings"),
        ("convert", convert, Verb, "Write a log in another format"),
        ("synth", synth, Verb, "Make a synthetic log with exact truth"),
    ],
}
"""The verbs by what they are for, as the help lists them; in the list of a group, those used most first."""

app = typer.Typer(
    cls=Guarded,
    context_settings=HELP,
    epilog="Example: mapper build LOG, or without a log: mapper demo",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # its pretty help takes longer to import than everything else to run
    add_completion=False,
)
for _panel, _members in _VERBS.items():
    for _name, _function, _class, _short in _members:
        app.command(_name, cls=_class, short_help=_short, rich_help_panel=_panel)(verb(_function))
app.add_typer(sensor, name="sensor", short_help="Measure a sensor's errors", rich_help_panel="study")
app.add_typer(
    vocabulary, name="vocabulary", short_help="Train and show visual words", rich_help_panel="tools"
)


@app.callback()
def start(
    ctx: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    install: Annotated[
        bool, typer.Option("--install-completion", help="Complete verbs, runs, settings … by Tab.")
    ] = False,
    show: Annotated[bool, typer.Option("--show-completion", help="Print the script that completes.")] = False,
    shell: Annotated[
        Literal["bash", "zsh", "fish"] | None,
        typer.Option(help="Shell for these two; omit for the current one."),
    ] = None,
) -> None:
    """Map recorded RGB-D and LiDAR logs: trajectory, pose graph, octree, 2D slice and MCAP log."""
    if version:
        print(f"mapper {__version__}")
    elif install or show:
        name = shell or completion.detected_shell()
        if show:
            print(completion.SCRIPTS[name], end="")
        else:
            print(f"{completion.install(name)}: completion for {name}, from the next shell on")
        raise typer.Exit
    elif ctx.invoked_subcommand is None:
        show_help(ctx)


def main() -> None:
    """Run the command line."""
    if completion.ASKED_BY in os.environ:
        completion.answer(typer.main.get_command(app))
        return
    prepare_environment()
    gc.set_threshold(_COLLECT_AFTER)
    handle_interrupts()
    for name in ("stdout", "stderr"):
        if stream := getattr(sys, name):  # None where the shell has closed it
            setattr(sys, name, EscapingStream(stream))
    warnings.showwarning = _show_warning
    warnings.simplefilter("always", MapperWarning)
    try:
        app()
    finally:
        if "velodyne_decoder" not in sys.modules:  # which would print all of it
            gc.freeze()  # or Python would search all that is left for cycles at the end, for half a second
