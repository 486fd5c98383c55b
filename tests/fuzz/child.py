"""Child process that reads inputs: ``python -m tests.fuzz.child MEMORY_BYTES``.

It takes a line of JSON for each input: the words of a command, which is a verb of ``mapper``, "all", or
"line" with a folder and the words of a command line that is run in it. It answers with another: the outcome
and the message, or the traceback of an error not of mapper's own.
"""

import errno
import json
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path

from mapper.core.errors import FrameError, MapperError
from mapper.runtime.worker_process import memory_limited

LONGEST_MESSAGE = 1000
_EXIT_REFUSED = 1
_WRITE_FLAGS = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_WRITING = {
    "open": (0,),
    **dict.fromkeys(("os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod", "shutil.rmtree"), (0,)),
    **dict.fromkeys(("os.rename", "os.link", "os.symlink"), (0, 1)),
}
"""Python's audit events that change files, and which of their arguments are paths."""
_HARMLESS = (Path.home() / ".cache", Path.home() / ".config/matplotlib", Path("/dev"), Path("/proc"))
"""What libraries write to, and where nothing is kept."""


class NotOneLineError(Exception):
    """A message to the user that is no line."""


def read_all(path: Path) -> str:
    """Read a map, or all of a log, and return what its reader noted.

    Raises:
        MapperError: It is damaged, or a frame of it is.
    """
    if path.suffix in (".octree", ".ot", ".bt"):
        from mapper.octree.map import read_octree

        read_octree(path).leaves()
        return ""
    from mapper.sources import open_source
    from mapper.sources.config import SourceConfig
    from mapper.sources.inspection import inspect_log

    inspect_log(path, SourceConfig())
    log = open_source(path)
    reason: FrameError | None = None
    for entry in log.entries():
        for read in (entry.load, entry.scan):
            try:
                read()
            except FrameError as error:
                reason = error
    if reason is not None:
        raise reason
    return "; ".join(log.notes)


def run_verb(words: Sequence[str]) -> str:
    """Run ``mapper`` with some words, and return its warnings.

    Raises:
        MapperError: It refused the input.
    """
    from typer.testing import CliRunner

    from mapper.cli.main import app

    result = CliRunner().invoke(app, list(words), catch_exceptions=False)
    if result.exit_code == _EXIT_REFUSED:  # inspect says on its standard output what is wrong
        raise MapperError((result.stderr or result.output).rstrip().rpartition("\n")[2])
    if result.exit_code:
        raise NotOneLineError(f"exit status {result.exit_code}: {result.output}")
    said: str = result.stderr.strip()
    return said


class OutsideError(Exception):
    """A line writes outside of the folder that it is run in."""


class WriteGuard:
    """Audit hook that refuses to write outside of a folder, as long as one is set, and remembers it."""

    def __init__(self) -> None:
        self.folder: Path | None = None
        self.refused = ""
        sys.addaudithook(self._check)

    def _check(self, event: str, given: tuple[object, ...]) -> None:
        if self.folder is None or event not in _WRITING:
            return
        if event == "open" and not (isinstance(given[2], int) and given[2] & _WRITE_FLAGS):
            return
        for path in (given[k] for k in _WRITING[event]):
            if not isinstance(path, str | bytes | os.PathLike):
                continue
            at = Path(os.fsdecode(path))
            at = at.parent.resolve() / at.name
            if (
                not any(map(at.is_relative_to, (self.folder.parent, *_HARMLESS)))
                and "__pycache__" not in at.parts
            ):
                self.refused = f"{event} {at}"
                raise PermissionError(errno.EACCES, "outside of the folder", str(at))


def run_line(guard: WriteGuard, folder: Path, words: Sequence[str]) -> str:
    """Run a command line in a folder, and return its warnings.

    Raises:
        MapperError: The line was refused.
        NotOneLineError: It was refused in another way than by a line.
        OutsideError: It would write outside of the folder and of the one around it.
    """
    from typer.testing import CliRunner

    from mapper.cli.main import app

    os.chdir(folder)
    guard.folder, guard.refused = folder, ""
    try:
        result = CliRunner().invoke(app, list(words), catch_exceptions=False)
    finally:
        guard.folder = None
        os.chdir("/")
    if guard.refused:
        raise OutsideError(guard.refused)
    said: str = result.stderr.rstrip()
    if "Traceback" in said:
        raise NotOneLineError(said)
    if result.exit_code == 0:
        return said
    last = (said or result.output.rstrip()).rpartition("\n")[2]
    if result.exit_code not in (1, 2) or (said and not last.startswith("mapper")):
        raise NotOneLineError(f"exit status {result.exit_code}: {result.output}")
    raise MapperError(last)


def run(guard: WriteGuard, words: Sequence[str]) -> str:
    """Run a command and return notes or warnings."""
    match words:
        case ["all", path]:
            return read_all(Path(path))
        case ["line", folder, *line]:
            return run_line(guard, Path(folder), line)
        case _:
            return run_verb(words)


def answer(guard: WriteGuard, words: Sequence[str]) -> dict[str, str]:
    """Return the outcome: "read", "noted" with the notes, "refused" and why, or "error" with a traceback."""
    try:
        notes = run(guard, words)
    except MapperError as error:
        message = str(error)
        if not message or "\n" in message or len(message) > LONGEST_MESSAGE:
            return {"outcome": "error", "detail": f"not one line: {message[:3000]!r}"}
        return {"outcome": "refused", "detail": message}
    except BaseException:  # also what Rust's libraries raise
        return {"outcome": "error", "detail": traceback.format_exc()}
    return {"outcome": "noted" if notes else "read", "detail": notes}


def main() -> None:
    """Answer until the input ends."""
    memory_bytes = int(sys.argv[1])
    warnings.simplefilter("error", RuntimeWarning)
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what a library prints is no answer
    guard = WriteGuard()
    for line in sys.stdin:
        with memory_limited(memory_bytes):  # for each input: threads of libraries keep address space
            found = answer(guard, json.loads(line))
        print(json.dumps(found), file=answers)


if __name__ == "__main__":
    main()
