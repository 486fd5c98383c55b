"""Tables of FlatBuffers, read by the numbers of their fields, with every offset checked.

Layout: https://flatbuffers.dev/internals. All numbers are little-endian.
"""

import struct
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mapper.core.errors import DataError


class Table:
    """A table within a buffer."""

    def __init__(self, data: memoryview, at: int) -> None:
        """Keep the buffer and where the table begins in it."""
        self._data, self._at = data, at

    @classmethod
    def of_buffer(cls, data: memoryview) -> "Table":
        """Return the root of a buffer that begins with its size.

        Raises:
            DataError: The buffer is too short.
        """
        return cls(data, 4 + _unpack(data, "I", 4))

    def number(self, field: int, kind: str, default: int = 0) -> int:
        """Return an integer of a kind as of ``struct``, or the default where it is absent."""
        at = self._place(field)
        return default if at is None else _unpack(self._data, kind, at)

    def array(self, field: int, dtype: DTypeLike) -> NDArray[Any]:
        """Return a vector of scalars or structs, (N,); empty where it is absent."""
        dtype = np.dtype(dtype)
        start, count = self.span(field)
        try:
            return np.frombuffer(self._data, dtype, count, start) if count else np.empty(0, dtype)
        except ValueError:
            raise DataError("a vector that goes beyond its buffer") from None

    def bytes(self, field: int) -> memoryview:
        """Return a vector of bytes; empty where it is absent."""
        start, size = self.span(field)
        if start + size > len(self._data):
            raise DataError("a vector that goes beyond its buffer")
        return self._data[start : start + size]

    def text(self, field: int) -> str:
        """Return a string; empty where it is absent."""
        return str(self.bytes(field), "utf-8", "replace")

    def tables(self, field: int) -> list["Table"]:
        """Return a vector of tables; empty where it is absent."""
        start, _ = self.span(field)
        offsets = self.array(field, "<u4")
        return [Table(self._data, start + 4 * i + int(offset)) for i, offset in enumerate(offsets)]

    def span(self, field: int) -> tuple[int, int]:
        """Return where the elements of a vector begin in the buffer, and their number."""
        at = self._place(field)
        if at is None:
            return 0, 0
        at += _unpack(self._data, "I", at)
        return at + 4, _unpack(self._data, "I", at)

    def _place(self, field: int) -> int | None:
        slots = self._at - _unpack(self._data, "i", self._at)
        slot = 4 + 2 * field
        if slot + 2 > _unpack(self._data, "H", slots):
            return None
        offset = _unpack(self._data, "H", slots + slot)
        return self._at + offset if offset else None


def _unpack(data: memoryview, kind: str, at: int) -> int:
    try:
        return int(struct.unpack_from(f"<{kind}", data, max(at, 0))[0])
    except struct.error:
        raise DataError("an offset that leaves its buffer") from None
