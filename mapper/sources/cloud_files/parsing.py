"""Helpers of the parsers of cloud files: their result, lines of text, and errors about damage."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from threading import Lock
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from mapper.core.errors import FrameError, listed
from mapper.core.units import MIB

Column = NDArray[np.number[Any]]
Columns = Mapping[str, Column]
"""(N,) values of each field of a cloud, by its name in the file."""

MIN_POINTS = 10
"""Fewer points show no surface that anything could be aligned to."""
MOST_BYTES = 1024 * MIB
"""Size of a cloud, in its file and unpacked: what is made of it takes up to twice as much memory again."""

HEADER_LINES = 1000
SAMPLES = 5000
"""Points by which a cloud is judged."""
MAX_RANGE_M = 1000.0
"""The longest automotive sensors see 0.5 km, depth cameras less; a room in millimetres is beyond it."""
_RUST_PANIC = "PanicException"
"""Name of the exception that a panic in a Rust library becomes; it derives from ``BaseException``."""


_ONE_HEADER = Lock()
"""NumPy parses an array's header with ``ast``, which counts its recursion for all threads together in Python
3.11 and may find it wrong."""

_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


@contextmanager
def refusing_damage(path: object, *, what: str) -> Iterator[None]:
    """Turn whatever a parser raises on a damaged file into one line about it.

    Raises:
        FrameError: The parser gave up; what the system refuses stays an OSError.
    """
    try:
        yield
    except (OSError, FrameError):
        raise
    except BaseException as error:  # parsers of foreign bytes raise whatever the line that met them raises
        if not (isinstance(error, Exception) or type(error).__name__ == _RUST_PANIC):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, ValidationError):
            lines = [f"{one['loc'][0]}: {one['msg']}" for one in error.errors(include_url=False)]
            reason = f"its header is not whole ({listed(lines)}); is the file empty, or was it cut?"
        raise FrameError(f"{path}: not a sound {what} file: {reason}") from None


def load_array(stream: BinaryIO, where: object) -> NDArray[Any]:
    """Return the array of a .npy file; ``where`` names it in an error.

    Raises:
        FrameError: It is damaged, or holds objects.
    """
    with refusing_damage(where, what="npy"), _ONE_HEADER:
        begin = stream.tell()
        version = np.lib.format.read_magic(stream)
        if version in _HEADERS and _HEADERS[version](stream)[2].hasobject:
            raise FrameError(f"{where}: objects of Python, which are not read; save an array of numbers")
        stream.seek(begin)
        return np.lib.format.read_array(stream, allow_pickle=False)


def parse_rows(lines: Iterable[bytes], dtype: np.dtype[np.void]) -> NDArray[np.void]:
    """Return the records in lines of text; blank lines are none.

    Raises:
        ValueError: A line is not one number of its type a field.
    """
    lines = [line for line in lines if line.strip()]
    return np.loadtxt(lines, dtype, comments=None, ndmin=1) if lines else np.empty(0, dtype)
