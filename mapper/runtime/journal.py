"""Files that survive a killed process: a journal of records, and a state of which two versions are kept.

A journal is only appended to. A state is written over the older of its two versions, and counts once it is on
the disk; it holds the length of the journal that belongs to it. Both have digests, which reveal damage.
"""

import hashlib
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from isal import igzip

from mapper.core.errors import DataError
from mapper.runtime.atomic import flush_to_disk
from mapper.runtime.state_file import Writes

_packed_file: Any = igzip.IGzipFile  # the library has no types
_HEAD = struct.Struct("<Q16s")
_STATE = struct.Struct("<16sQ32s")
_STATE_MAGIC = b"mapper state 1\n\0"


@dataclass(slots=True)
class Journal:
    """Journal: records of bytes, found by their place in the file.

    Attributes:
        path: The file.
        end: Its length with the records that are still to be written.
    """

    path: Path
    end: int = 0
    _pending: list[bytes] = field(default_factory=list)
    _opened: BinaryIO | None = None

    def append(self, record: bytes) -> int:
        """Return the place of a new record, which is pending until it is taken and written."""
        place = self.end
        self._pending += (_HEAD.pack(len(record), _digest(record)), record)
        self.end += _HEAD.size + len(record)
        return place

    def take(self) -> list[bytes]:
        """Return the pending records, to be written by ``write`` in any thread."""
        pending, self._pending = self._pending, []
        return pending

    def write(self, taken: list[bytes]) -> None:
        """Append what was taken, and wait until it is on the disk."""
        with self.path.open("ab") as file:
            file.writelines(taken)
            file.flush()
            os.fsync(file.fileno())

    def truncate(self, end: int) -> None:
        """Leave out what is beyond an end: records that belong to no state, and an incomplete one."""
        os.truncate(self.path, end)
        self.end = end

    def remove(self) -> None:
        """Delete the file and all pending records."""
        self.close()
        self._pending, self.end = [], 0
        self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close what ``read`` has opened."""
        opened, self._opened = self._opened, None
        if opened is not None:
            opened.close()

    def open(self) -> BinaryIO:
        """Return the file, open for ``read``: from now on it can be deleted, and is still read."""
        self._opened = self._opened or self.path.open("rb", buffering=0)
        return self._opened

    def read(self, place: int) -> bytes:
        """Return the record at a place that has been written.

        Raises:
            DataError: It cannot be read, or is damaged.
        """
        try:
            file = self.open()
            file.seek(place)
            return self._next_record(file, place, self.end)
        except OSError as error:
            raise DataError(f"{self.path}: cannot be read: {error.strerror}") from None

    def records(self, end: int) -> Iterator[tuple[int, bytes]]:
        """Yield the place and the bytes of every record before an end.

        Raises:
            DataError: One is torn or damaged.
        """
        try:
            with self.path.open("rb") as file:
                while (place := file.tell()) < end:
                    yield place, self._next_record(file, place, end)
        except OSError as error:
            raise DataError(f"{self.path}: cannot be read: {error.strerror}") from None

    def _next_record(self, file: BinaryIO, place: int, end: int) -> bytes:
        """Return the record at the place where a file is read, which must lie before an end."""
        head = file.read(_HEAD.size)
        length, digest = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, b"")
        record = file.read(length) if place + _HEAD.size + length <= end else b""
        if _digest(record) != digest:
            raise DataError(f"{self.path}: damaged at byte {place}")
        return record


@dataclass(frozen=True, slots=True)
class StateFile:
    """Numbered versions of a state, of which the last two are kept.

    Attributes:
        folder: Folder of the two files.
        name: Beginning of both names.
    """

    folder: Path
    name: str

    def write(self, number: int, save: Callable[[Writes], object]) -> None:
        """Write a version over the older one by a function, and wait until it is on the disk."""
        path = self._paths[number % 2]
        with path.open("wb") as file:
            file.write(bytes(_STATE.size))
            hashed = _HashedFile(file, _hash_of(number))
            with _packed_file(fileobj=hashed, mode="wb", compresslevel=1, mtime=0) as packed:
                save(packed)
            file.seek(0)
            file.write(_STATE.pack(_STATE_MAGIC, number, hashed.digest.digest()))
            file.flush()
            os.fsync(file.fileno())
        if number < 2:
            flush_to_disk(self.folder)

    def versions(self) -> tuple[dict[int, Path], int]:
        """Return the whole versions by number, the newest first, and how many are damaged."""
        there = [path for path in self._paths if path.exists()]
        found = {number: path for path in there if (number := _whole(path)) is not None}
        return dict(sorted(found.items(), reverse=True)), len(there) - len(found)

    def remove(self) -> None:
        """Delete both versions."""
        for path in self._paths:
            path.unlink(missing_ok=True)

    @property
    def _paths(self) -> list[Path]:
        return [self.folder / f"{self.name}.{half}" for half in (0, 1)]


def _digest(record: bytes) -> bytes:
    return hashlib.sha256(record).digest()[:16]


@contextmanager
def opened_state(path: Path) -> Iterator[BinaryIO]:
    """Open a version of a state that ``StateFile.versions`` has found."""
    with path.open("rb") as file:
        file.seek(_STATE.size)
        with _packed_file(fileobj=file, mode="rb") as packed:
            yield packed


@dataclass(frozen=True, slots=True)
class _HashedFile:
    """File of a state whose digest is taken as it is written."""

    file: BinaryIO
    digest: "hashlib._Hash"

    def write(self, data: Any, /) -> int:
        self.digest.update(data)
        return self.file.write(data)

    def flush(self) -> None:
        self.file.flush()


def _hash_of(number: int) -> "hashlib._Hash":
    return hashlib.sha256(number.to_bytes(8, "little"))


def _whole(path: Path) -> int | None:
    """Return the number of a version; None if it is torn or damaged."""
    try:
        with path.open("rb") as file:
            head = file.read(_STATE.size)
            if len(head) < _STATE.size:
                return None
            magic, number, wanted = _STATE.unpack(head)
            digest = _hash_of(number)
            while piece := file.read(1 << 20):
                digest.update(piece)
    except OSError:
        return None
    return int(number) if magic == _STATE_MAGIC and digest.digest() == wanted else None
