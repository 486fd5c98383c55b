"""Array in a file: what is not used of it the system writes out when memory is short."""

import mmap
import os
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mapper.runtime.atomic import writing

_CHUNK = 1 << 20


class FileArray:
    """Rows of numbers in a file without a name, mapped into memory; it is gone when the process ends."""

    def __init__(self, folder: Path, columns: int, kind: DTypeLike) -> None:
        """Start without rows.

        Args:
            folder: Folder on the disk that takes the file.
            columns: Numbers in a row.
            kind: Type of the numbers.

        Raises:
            WriteError: The file cannot be made.
        """
        self._folder, self._columns, self._kind = folder, columns, np.dtype(kind)
        with writing(folder):
            self._file = TemporaryFile(dir=folder)  # noqa: SIM115  it is open as long as the array

    def grown(self, rows: int) -> NDArray[Any]:
        """Return the (rows, columns) array: the rows so far, and further ones of zeros.

        Arrays that were returned before are parts of it.

        Raises:
            WriteError: The disk is full.
        """
        size = rows * self._columns * self._kind.itemsize
        with writing(self._folder):
            self._reserve(size)
            mapped = mmap.mmap(self._file.fileno(), size)
        return np.frombuffer(mapped, self._kind).reshape(rows, self._columns)

    def _reserve(self, size: int) -> None:
        """Allocate bytes of the disk for the file: a page without room there would end the process."""
        reserve = getattr(os, "posix_fallocate", None)  # not on macOS and Windows
        if reserve is not None:
            reserve(self._file.fileno(), 0, size)
            return
        at = self._file.seek(0, os.SEEK_END)
        while at < size:
            at += self._file.write(bytes(min(size - at, _CHUNK)))
        self._file.flush()
