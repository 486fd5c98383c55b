"""Work done ahead of time in threads, in order, without ever holding the whole log."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def ordered_map(
    work: Callable[[Item], Result], items: Iterable[Item], *, workers: int = 2, ahead: int = 8
) -> Iterator[Result]:
    """Yield ``work(item)`` for every item, in order, computing up to ``ahead`` results early.

    The results do not depend on the number of workers. An exception of ``work`` surfaces
    where its result would.

    Args:
        work: Thread-safe function; gains from threads if it releases the GIL, as OpenCV and numba do.
        items: Read in the caller's thread, a few at a time.
        workers: Threads; 0 works in the caller's thread.
        ahead: Number of results that may be pending.
    """
    if workers == 0:
        yield from map(work, items)
        return
    iterator = iter(items)
    with ThreadPoolExecutor(workers, thread_name_prefix="mapper") as pool:
        pending: deque[Future[Result]] = deque(pool.submit(work, item) for item in islice(iterator, ahead))
        try:
            while pending:
                result = pending.popleft().result()
                for item in islice(iterator, 1):
                    pending.append(pool.submit(work, item))
                yield result
        finally:
            for future in pending:
                future.cancel()
