"""Regular files of a bounded size, as bytes and as text; devices and pipes may never end, or never begin."""

import os
import re
import stat
import tomllib
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from mapper.core.errors import DataError, MapperError
from mapper.core.units import MIB

MOST_BYTES = 512 * MIB
"""Size of a text, an image or a block of a recording, beyond which it is taken for something else: the true
poses of twenty hours at 100 Hz fill it, and as lines they take gigabytes of memory."""
MOST_UNPACKED_RATIO = 255
"""Times the size of what is stored that it may unpack to: of LZ4 a byte expands to no more, of LZF to 88;
logs unpack to less than ten times their size, and a hostile file could keep its reader busy for days."""
HEAD_BYTES = 65_536
"""Bytes of a file that are read to tell what it is."""

_MOST_TOML_CHARACTERS = MIB
_MOST_KEY_PARTS = 32

_reads: ContextVar[set[Path] | None] = ContextVar("reads", default=None)


@contextmanager
def reads() -> Iterator[set[Path]]:
    """Yield a set to which the path of every file is added that is read meanwhile."""
    paths: set[Path] = set()
    token = _reads.set(paths)
    try:
        yield paths
    finally:
        _reads.reset(token)


def read_regular(path: Path, *, most_bytes: int, may_be_pipe: bool = False) -> bytes:
    """Return a file's bytes.

    Args:
        path: A regular file, or a link to one.
        most_bytes: Size of the largest file that is read.
        may_be_pipe: Read a pipe too: the user named it, and not a log.

    Raises:
        OSError: It cannot be read.
        DataError: It is no regular file, or larger; the message does not name it.
    """
    if (paths := _reads.get()) is not None:
        paths.add(path)
    wait = 0 if may_be_pipe else getattr(os, "O_NONBLOCK", 0)  # opening a pipe waits for its writer
    with os.fdopen(os.open(path, os.O_RDONLY | wait), "rb") as file:
        status = os.fstat(file.fileno())
        if stat.S_ISREG(status.st_mode):
            if status.st_size > most_bytes:
                raise DataError(f"{status.st_size} bytes, want {most_bytes} at most")
            return file.read()
        if not (may_be_pipe and stat.S_ISFIFO(status.st_mode)):
            raise DataError("no regular file")
        data = file.read(most_bytes + 1)
        if len(data) > most_bytes:
            raise DataError(f"more than {most_bytes} bytes")
        return data


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tree of a TOML document.

    A key of thousands of parts, which is a thing of kilobytes, would take gigabytes to parse.

    Raises:
        ValueError: It is no TOML, or larger or deeper than any that people write.
    """
    if len(text) > _MOST_TOML_CHARACTERS:
        raise ValueError(f"{len(text)} characters, at most {_MOST_TOML_CHARACTERS} are read")
    words = re.split(r"[=,\[\]{}#\r\n]", text.replace(" ", "").replace("\t", ""))
    if (deepest := max((word.count(".") for word in words), default=0)) > _MOST_KEY_PARTS:
        raise ValueError(f"a key of {deepest + 1} parts, at most {_MOST_KEY_PARTS} are read")
    return tomllib.loads(text)


def read_text(
    path: Path,
    *,
    error: type[MapperError] = DataError,
    encoding: str = "utf-8",
    may_be_pipe: bool = False,
) -> str:
    """Return the text of a file, without the byte order mark with which Windows programs begin one.

    By that mark it is read as UTF-16, as PowerShell writes it.

    Args:
        path: File, as of :func:`read_regular`.
        error: Class of the error.
        encoding: Encoding of the text.
        may_be_pipe: Whether it may be a pipe, as of :func:`read_regular`.

    Raises:
        MapperError: ``error``: it cannot be read, is no regular file, too large or no text; the message says
            which file.
    """
    try:
        data = read_regular(path, most_bytes=MOST_BYTES, may_be_pipe=may_be_pipe)
        if data.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
            encoding = "utf-16"
        return data.decode(encoding).removeprefix("\ufeff")
    except OSError as why:
        raise error(f"{path}: cannot be read: {why.strerror}") from None
    except UnicodeDecodeError as why:
        raise error(f"{path}: not a text file: byte {why.start} is not {encoding.upper()}") from None
    except (DataError, MemoryError) as why:
        raise error(f"{path}: {why or 'does not fit into memory'}") from None


AnyPath = str | os.PathLike[str]
"""Path of a file or folder: text, or a ``pathlib.Path``."""
