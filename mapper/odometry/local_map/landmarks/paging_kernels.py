"""Compiled translation of a paged table's ids to rows in memory."""

from numba import njit

PAGE_BITS = 10
"""A page has 2 to the power of so many rows."""


@njit(cache=True, nogil=True)
def row_of(id_, slot_of, used, now):
    """Return the row of an id in memory, and take note that its page was used; −1 if that is not in memory.

    Args:
        id_: ≥ 0.
        slot_of: (P,) int32: place of each page in memory, −1 if it is not there.
        used: (P,) int64: step in which each page was used last.
        now: The current step.
    """
    page = id_ >> PAGE_BITS
    slot = slot_of[page]
    if slot < 0:
        return -1
    used[page] = now
    return (slot << PAGE_BITS) | (id_ & ((1 << PAGE_BITS) - 1))


@njit(cache=True, nogil=True)
def find_rows(ids, slot_of, used, now, written, writes, rows):
    """Write the rows of ids; return the first page that is not in memory, −1 if all are.

    Args:
        ids: (N,) int; the row of a negative one, which is none, is 0.
        slot_of: As for ``row_of``.
        used: As for ``row_of``.
        now: As for ``row_of``.
        written: (P,) whether a page has changed.
        writes: Whether these do.
        rows: (N,) int64.
    """
    for n in range(len(ids)):
        if ids[n] < 0:
            rows[n] = 0
            continue
        row = row_of(ids[n], slot_of, used, now)
        if row < 0:
            return ids[n] >> PAGE_BITS
        written[ids[n] >> PAGE_BITS] |= writes
        rows[n] = row
    return -1
