"""The command line: its verbs, and the one place that turns an error into a line and an exit status."""

import errno
import sys
import warnings
from typing import Annotated, Any, TextIO

import typer
from typer.core import TyperGroup

from cli.build import build
from cli.compare import compare
from cli.convert import convert
from cli.demo import demo
from cli.diff import diff
from cli.doctor import doctor
from cli.edit import edit
from cli.environment import prepare_environment
from cli.evaluate import evaluate
from cli.export import export
from cli.fuse import fuse
from cli.inspect import inspect
from cli.interrupts import handle_interrupts
from cli.localise import localise
from cli.loops import WithPairs, loops
from cli.merge import merge
from cli.plan import WithPoints, plan
from cli.register import register
from cli.report import report
from cli.reproduce import reproduce
from cli.sensor import sensor
from cli.show_config import show_config
from cli.solve import solve
from cli.sweep import sweep
from cli.synth import synth
from cli.terminal import EscapingStream, escaped
from cli.view import view
from cli.vocabulary import vocabulary
from mapper import __version__
from mapper.core.errors import MapperError, MapperWarning, Terminated

_INTERRUPTED, _TERMINATED = 130, 143  # 128 + SIGINT, 128 + SIGTERM, as shells count
_USER_CAN_HELP = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES, errno.EPERM, errno.EROFS}


class Guarded(TyperGroup):
    """Turns a user's mistake into one line; a bug keeps its traceback."""

    def invoke(self, ctx: Any) -> Any:
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
    print(escaped(line, one_line=True), file=sys.stderr)


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    if issubclass(category, MapperWarning):
        print(escaped(f"mapper: {message}", one_line=True), file=sys.stderr)
    else:
        _python_shows_warning(message, category, filename, lineno, file, line)


_python_shows_warning = warnings.showwarning

app = typer.Typer(
    cls=Guarded,
    epilog="Example: mapper demo, or: mapper build LOG --out RUN",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # its pretty help takes longer to import than everything else to run
    add_completion=False,
)
app.command("build")(build)
app.command("fuse")(fuse)
app.command("loops", cls=WithPairs)(loops)
app.command("eval")(evaluate)
app.command("edit")(edit)
app.command("export")(export)
app.command("localise")(localise)
app.command("merge")(merge)
app.command("diff")(diff)
app.command("plan", cls=WithPoints)(plan)
app.command("solve")(solve)
app.command("register")(register)
app.command("compare")(compare)
app.command("sweep")(sweep)
app.command("reproduce")(reproduce)
app.command("inspect")(inspect)
app.command("convert")(convert)
app.command("synth")(synth)
app.command("demo")(demo)
app.command("config")(show_config)
app.command("view")(view)
app.command("report")(report)
app.command("doctor")(doctor)
app.add_typer(sensor, name="sensor")
app.add_typer(vocabulary, name="vocabulary")


@app.callback(invoke_without_command=True)
def version(
    show: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Map recorded RGB-D and LiDAR logs: trajectory, pose graph, octree, 2D slice and MCAP log."""
    if show:
        print(f"mapper {__version__}")
        raise typer.Exit


def main() -> None:
    """Run the command line."""
    prepare_environment()
    handle_interrupts()
    for name in ("stdout", "stderr"):
        if stream := getattr(sys, name):  # None where the shell has closed it
            setattr(sys, name, EscapingStream(stream))
    warnings.showwarning = _show_warning
    warnings.simplefilter("always", MapperWarning)
    app()
