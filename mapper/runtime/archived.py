"""Data that never changes once it is made: in memory, or read from an archive on use."""

from collections.abc import Iterator, Mapping
from typing import Any, Generic, Protocol, TypeVar, cast

Data = TypeVar("Data")


class Archivable:
    """Base of data that never changes once it is made, so that an archive writes it once.

    Subclasses are frozen dataclasses with slots.
    """

    __slots__ = ("_archived",)


class Reader(Protocol):
    """Reader of data that was written; see ``mapper.runtime.archive.Archive``."""

    def read(self, archived: "Archived[Any]", /) -> Any:
        """Return the data."""
        ...


class Archived(Generic[Data]):
    """Reference to data that may lie on the disk: what is kept for long refers to data by it."""

    __slots__ = ("_data", "_reader", "place")

    def __init__(self, data: Data | None, *, reader: Reader | None = None, place: int | None = None) -> None:
        """Refer to data in memory; or without any, to what a reader has at a place."""
        self._data = data
        self._reader = reader
        self.place = place
        """Place in the archive; None if it is in none."""

    @property
    def data(self) -> Data:
        """The data; it may be read from the disk, so that two calls may return two equal objects.

        Raises:
            DataError: It cannot be read, or is damaged.
        """
        if self._data is not None:
            return self._data
        assert self._reader is not None
        return cast(Data, self._reader.read(self))

    def release(self, reader: Reader) -> None:
        """Leave the data to a reader, which has it from now on."""
        self._data, self._reader = None, reader


def archived(data: Data) -> Archived[Data]:
    """Return the reference to data, the same one every time for data of a class that can be archived."""
    if not isinstance(data, Archivable):
        return Archived(data)
    known: Archived[Data] | None = reference_of(data)
    if known is None:
        known = Archived(data)
        refer(data, known)
    return known


def reference_of(data: Archivable) -> Archived[Any] | None:
    """Return the reference to some data; None if there is none yet."""
    return getattr(data, "_archived", None)


def refer(data: Archivable, reference: Archived[Any]) -> None:
    """Store the reference to some data in the data."""
    object.__setattr__(data, "_archived", reference)


class ArchivedMapping(Mapping[int, Data]):
    """Mapping to data that may lie on the disk: a value is read on access."""

    def __init__(self, references: Mapping[int, Archived[Data]]) -> None:
        """Take over references, in their order."""
        self._references = references

    def __getitem__(self, key: int) -> Data:
        return self._references[key].data

    def __contains__(self, key: object) -> bool:
        return key in self._references

    def __iter__(self) -> Iterator[int]:
        return iter(self._references)

    def __len__(self) -> int:
        return len(self._references)
