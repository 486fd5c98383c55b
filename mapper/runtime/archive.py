"""Archive: data of a build that never changes, written once; what was used last is in memory.

Keyframes' features and scans are most of what a long log leaves behind, and are needed again only where the
path comes back. Each is one record of a journal, which checkpoints refer to.
"""

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from isal import isal_zlib

from mapper.core.units import MIB
from mapper.runtime.archived import Archivable, Archived, refer
from mapper.runtime.journal import Journal
from mapper.runtime.state_file import dumps, loads

RECENT_BYTES = 128 * MIB
"""Size of the data in memory that is on the disk as well: some 500 keyframes of 1000 features."""


class Archive:
    """Archive on top of a journal, to which its owner may write other records.

    All calls come from one thread, but for those of the journal's own ``write``.
    """

    def __init__(self, journal: Journal, *, recent_bytes: int = RECENT_BYTES) -> None:
        """Start with what the journal has.

        Args:
            journal: Journal of the build.
            recent_bytes: Largest size of the data in memory that is on the disk as well.
        """
        self._journal = journal
        self._recent_bytes = recent_bytes
        self._recent: OrderedDict[int, tuple[Any, int]] = OrderedDict()
        self._size = 0
        self._references: dict[int, Archived[Any]] = {}
        self._new: list[Archived[Any]] = []

    def place_of(self, reference: Archived[Any]) -> int:
        """Return where the journal has some data; what it has not is appended, to be written."""
        if reference.place is None:
            record = pack(dumps(reference.data, archive=self.place_of))
            reference.place = self._journal.append(record)
            self._references[reference.place] = reference
            self._new.append(reference)
        return reference.place

    def at(self, place: int) -> Archived[Any]:
        """Return the reference to what the journal has at a place, the same one every time."""
        if place not in self._references:
            self._references[place] = Archived(None, reader=self, place=place)
        return self._references[place]

    def take(self) -> list[Archived[Any]]:
        """Return the data appended since the last call, to be released once the journal has been written."""
        new, self._new = self._new, []
        return new

    def release(self, written: list[Archived[Any]]) -> None:
        """Keep data that is on the disk only while it is among the last that were used."""
        if written:
            self._journal.open()
        for reference in written:
            assert reference.place is not None
            self._cache(reference.place, reference.data)
            reference.release(self)

    def read(self, reference: Archived[Any], /) -> Any:
        """Return data that is on the disk.

        Raises:
            DataError: It cannot be read, or is damaged.
        """
        assert reference.place is not None
        if reference.place in self._recent:
            self._recent.move_to_end(reference.place)
            return self._recent[reference.place][0]
        data = loads(unpack(self._journal.read(reference.place)), archived=self.at)
        if isinstance(data, Archivable):
            refer(data, reference)
        self._cache(reference.place, data)
        return data

    def clear(self) -> None:
        """Drop all data, as the journal does when it is deleted."""
        self._recent.clear()
        self._references.clear()
        self._new, self._size = [], 0

    def _cache(self, place: int, data: Any) -> None:
        size = size_of(data)
        self._recent[place] = data, size
        self._size += size
        while self._size > self._recent_bytes and len(self._recent) > 1:
            _, (_, freed) = self._recent.popitem(last=False)
            self._size -= freed


def pack(data: bytes) -> bytes:
    """Return bytes compressed, fast rather than well."""
    return bytes(isal_zlib.compress(data, 1))


def unpack(record: bytes) -> bytes:
    """Return what was packed."""
    return bytes(isal_zlib.decompress(record))


def size_of(data: Any) -> int:
    """Return the bytes of the arrays in a dataclass, and in the dataclasses and mappings in it."""
    arrays: dict[int, int] = {}
    parts = [data]
    while parts:
        part = parts.pop()
        if isinstance(part, np.ndarray):
            arrays[id(part)] = part.nbytes
        elif is_dataclass(part):
            parts += [getattr(part, field.name) for field in fields(part)]
        elif isinstance(part, Mapping):
            parts += part.values()
    return sum(arrays.values())
