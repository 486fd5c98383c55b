"""Child process that reads inputs: ``python -m tests.fuzz.child MEMORY_BYTES``.

It takes a line of JSON for each input: the words of a command, which is a verb of ``mapper``, or "all". It
answers with another: the outcome and the message, or the traceback of an error not of mapper's own.
"""

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


def run(words: Sequence[str]) -> str:
    """Run a command and return notes or warnings."""
    return read_all(Path(words[1])) if words[0] == "all" else run_verb(words)


def answer(words: Sequence[str]) -> dict[str, str]:
    """Return the outcome: "read", "noted" with the notes, "refused" and why, or "error" with a traceback."""
    try:
        notes = run(words)
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
    for line in sys.stdin:
        with memory_limited(memory_bytes):  # for each input: threads of libraries keep address space
            found = answer(json.loads(line))
        print(json.dumps(found), file=answers)


if __name__ == "__main__":
    main()
