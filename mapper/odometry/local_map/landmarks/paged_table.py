"""Table of arrays that grows by appending rows, of which those used lately are in memory: demand paging."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.odometry.local_map.landmarks.paging_kernels import PAGE_BITS, find_rows
from mapper.runtime.archived import Archivable, Archived, archived

PAGE_ROWS = 1 << PAGE_BITS
WORKING_SET_STEPS = 64
"""A page that was not used in so many steps is left to the archive (Denning 1968)."""
_EVERY_STEPS = 16
_FREE = _ABSENT = -1


@dataclass(frozen=True, slots=True, eq=False)
class _Page(Archivable):
    columns: Mapping[str, NDArray[Any]]


class PagedTable:
    """Columns of equal length, whose rows have ids counted from 0.

    ``table[name]`` is read and written by arrays of ids, as an array is. In memory, and whole in the state of
    a checkpoint, are the pages that were used in the last steps; the others are left to the archive, and read
    when an id leads there. Without an archive they stay in memory.
    """

    def __init__(self, **columns: tuple[tuple[int, ...], type]) -> None:
        """Begin without rows; each column has a shape and a type of its rows."""
        self._begin({name: np.zeros((PAGE_ROWS, *shape), kind) for name, (shape, kind) in columns.items()})

    def _begin(self, columns: dict[str, NDArray[Any]]) -> None:
        self.size = 0
        self._columns = columns  # (slots · PAGE_ROWS, …)
        self._page_in = [_FREE]  # of each slot
        self._left: dict[int, Archived[_Page]] = {}  # pages as they were when they left the memory
        self._slot_of = np.full(64, _ABSENT, np.int32)  # of each page, as are the next two
        self._used = np.zeros(64, np.int64)
        self._written = np.zeros(64, np.bool_)
        self._now = 0

    def __getitem__(self, name: str) -> "Column":
        return Column(self, name)

    def __getstate__(self) -> dict[str, Any]:
        """Return the pages in memory, and references to the others."""
        pages = [self._left[page] if self._is_left(page) else self._page(page) for page in range(self._pages)]
        empty = {name: column[:0].copy() for name, column in self._columns.items()}
        return {"size": self.size, "empty": empty, "pages": pages}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        empty = state["empty"].items()
        self._begin({name: np.zeros((PAGE_ROWS, *of.shape[1:]), of.dtype) for name, of in empty})
        self.size = state["size"]
        self._make_room()
        for page, known in enumerate(state["pages"]):
            if isinstance(known, Archived):
                self._left[page] = known
            else:
                self._put(page, known)
                self._written[page] = True

    def append(self, count: int, **values: object) -> NDArray[np.int32]:
        """Append rows by the values of all columns, and return their ids."""
        ids = np.arange(self.size, self.size + count, dtype=np.int32)
        before = self._pages
        self.size += count
        self._make_room()
        for page in range(before, self._pages):
            self._put(page, None)
        for name, value in values.items():
            self[name][ids] = value
        return ids

    def step(self) -> None:
        """Begin the next step, and leave the pages to the archive that were not used for long."""
        self._now += 1
        if self._now % _EVERY_STEPS:
            return
        for page in [page for page in self._page_in if page != _FREE]:
            if self._used[page] < self._now - WORKING_SET_STEPS:
                self._leave(page)

    def rows(self, ids: NDArray[np.integer], *, writes: bool = False) -> NDArray[np.int64]:
        """Return where in the columns the rows of ids are now; of a negative id, which is none, any."""
        rows = np.empty(len(ids), np.int64)
        while True:
            missing = find_rows(ids, self._slot_of, self._used, self._now, self._written, writes, rows)
            if missing < 0:
                return rows
            self._put(missing, self._left[missing].data)

    def follow(self, walk: Callable[..., Any], *arguments: object, columns: tuple[str, ...]) -> Any:
        """Return what a compiled function finds that follows ids from row to row.

        It takes its arguments, columns, and what ``row_of`` takes; it returns the page that it misses, −1 if
        none, and what it has found.
        """
        while True:
            read = [self._columns[name] for name in columns]
            missing, found = walk(*arguments, *read, self._slot_of, self._used, self._now)
            if missing < 0:
                return found
            self._put(missing, self._left[missing].data)

    @property
    def _pages(self) -> int:
        return -(-self.size // PAGE_ROWS)

    def _is_left(self, page: int) -> bool:
        """Return whether a page is not in memory, or has not changed since it was not."""
        return self._slot_of[page] == _ABSENT or (page in self._left and not self._written[page])

    def _page(self, page: int) -> _Page:
        """Return a copy of a page that is in memory."""
        first = self._slot_of[page] * PAGE_ROWS
        rows = slice(first, first + PAGE_ROWS)
        return _Page({name: column[rows].copy() for name, column in self._columns.items()})

    def _leave(self, page: int) -> None:
        if not self._is_left(page):
            self._left[page] = archived(self._page(page))
        self._page_in[self._slot_of[page]] = _FREE
        self._slot_of[page] = _ABSENT

    def _put(self, page: int, data: _Page | None) -> None:
        """Put a page into a free slot: as it left, or a new one of zeros."""
        if _FREE not in self._page_in:
            for name, column in self._columns.items():
                self._columns[name] = np.concatenate([column, np.zeros_like(column)])
            self._page_in += [_FREE] * len(self._page_in)
        slot = self._page_in.index(_FREE)
        for name, column in self._columns.items():
            column[slot * PAGE_ROWS : (slot + 1) * PAGE_ROWS] = 0 if data is None else data.columns[name]
        self._page_in[slot], self._slot_of[page] = page, slot
        self._used[page], self._written[page] = self._now, data is None

    def _make_room(self) -> None:
        """Let what is known of each page have room for all."""
        while self._pages > len(self._slot_of):
            self._slot_of = np.concatenate([self._slot_of, np.full_like(self._slot_of, _ABSENT)])
            self._used = np.concatenate([self._used, np.zeros_like(self._used)])
            self._written = np.concatenate([self._written, np.zeros_like(self._written)])


class Column:
    """Column of a paged table."""

    __slots__ = ("_name", "_table")

    def __init__(self, table: PagedTable, name: str) -> None:
        self._table, self._name = table, name

    def __getitem__(self, ids: NDArray[np.integer]) -> NDArray[Any]:
        """Return the values of rows by their ids; of a negative id, which is none, any."""
        rows = self._table.rows(ids)
        return self._table._columns[self._name][rows]

    def __setitem__(self, ids: NDArray[np.integer], values: object) -> None:
        rows = self._table.rows(ids, writes=True)
        self._table._columns[self._name][rows] = values
