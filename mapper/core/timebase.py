"""Time as int nanoseconds: exact text conversion and nearest-stamp association."""

import re
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapper.core.errors import DataError

NS_PER_S = 1_000_000_000
UNITS_PER_S = (1, 1_000, 1_000_000, NS_PER_S)
"""Seconds, milliseconds, microseconds and nanoseconds."""
GPS_EPOCH_S = 315_964_800 - 18
"""Unix time at which GPS time is 0, seconds: 1980-01-06, less the leap seconds that it has not had since."""
LATEST_NS = 1 << 62
"""In the year 2116; differences of earlier stamps fit into 64 bits."""
GAP_INTERVALS = 3.0
"""A pause longer than this number of usual intervals is a gap."""
_LARGEST_S = np.iinfo(np.int64).max // NS_PER_S
_LAST_SECOND = np.iinfo(np.int32).max + 1  # builtin_interfaces/Time counts seconds in an int32
_DATE = re.compile(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?Z?")

MAX_TRUTH_GAP_NS = 20_000_000
"""Limit between the stamps of a frame and of its true pose: that of TUM's tools."""

Stamps = NDArray[np.int64]
"""(N,) int64 nanoseconds since the Unix epoch (or the log's own zero)."""


def check_stamp(stamp_ns: int) -> None:
    """Raise for a stamp that a message of a run's MCAP log cannot hold.

    Raises:
        DataError: It is before 1970 or after 2038.
    """
    if not 0 <= stamp_ns < _LAST_SECOND * NS_PER_S:
        raise DataError(
            f"stamp {stamp_ns / NS_PER_S:.9g} s: MCAP messages hold 0 … 2³¹ s (1970 to 2038); shift the log, "
            "or write seconds where these are ms, µs or ns"
        )


def check_stamps(stamps_ns: Stamps) -> None:
    """Raise for the first or last of a log's stamps, as :func:`check_stamp` does.

    Raises:
        DataError: As :func:`check_stamp`.
    """
    if len(stamps_ns):
        check_stamp(int(stamps_ns.min()))
        check_stamp(int(stamps_ns.max()))


def ns_from_seconds_text(text: str) -> int:
    """Parse decimal seconds exactly: "1305031102.175304" becomes 1305031102175304000.

    Raises:
        DataError: The text is not a finite decimal number, or too large for int64 nanoseconds.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise DataError(f"stamp {text!r} is not a decimal number of seconds") from None
    if not seconds.is_finite():
        raise DataError(f"stamp {text!r} is not finite")
    if not -_LARGEST_S <= seconds <= _LARGEST_S:
        raise DataError(
            f"stamp {text!r} lies more than 292 years from zero, which 64 bits cannot hold; want seconds"
        )
    return int(seconds * NS_PER_S)


def ns_from_date_text(text: str) -> int:
    """Parse a date and time of day, UTC, exactly: "1970-01-01 00:00:01.000000002" becomes 1000000002.

    Raises:
        DataError: The text is no such date, or has more than nine decimals.
    """
    found = _DATE.fullmatch(text)
    try:
        if found is None:
            raise ValueError("want YYYY-MM-DD hh:mm:ss with at most nine decimals")
        moment = datetime.fromisoformat(f"{found[1]}T{found[2]}").replace(tzinfo=UTC)
    except ValueError as error:
        raise DataError(f"stamp {text!r} is no date and time: {error}") from None
    since_epoch = moment - datetime.fromtimestamp(0, tz=UTC)
    whole_s = since_epoch.days * 86400 + since_epoch.seconds
    return whole_s * NS_PER_S + int((found[3] or "0").ljust(9, "0"))


def seconds_text_from_ns(stamp_ns: int) -> str:
    """Return decimal seconds that parse back to the same stamp; at least six decimals, as TUM writes them."""
    sign = "-" if stamp_ns < 0 else ""
    whole, fraction = divmod(abs(int(stamp_ns)), NS_PER_S)
    digits = f"{fraction:09d}"
    return f"{sign}{whole}.{digits[:6]}{digits[6:].rstrip('0')}"


def stretches(marked: ArrayLike, *, margin: int = 0) -> list[tuple[int, int]]:
    """Return the first and the last index of each stretch of frames that are marked.

    Args:
        marked: (N,) bool.
        margin: Number of frames to add on either side, as far as there are any.
    """
    edges = np.diff(np.concatenate([[False], np.asarray(marked, np.bool_), [False]]).astype(np.int8))
    first, last = np.flatnonzero(edges == 1) - margin, np.flatnonzero(edges == -1) - 1 + margin
    return list(zip(first.clip(0).tolist(), last.clip(max=len(edges) - 2).tolist(), strict=True))


def nearest(stamps_ns: Stamps, wanted_ns: Stamps) -> tuple[NDArray[np.intp], Stamps]:
    """Return, for every wanted stamp, the index of the nearest stamp and the gap to it.

    Args:
        stamps_ns: (N,) increasing, N ≥ 1.
        wanted_ns: (M,) in any order.

    Returns:
        (M,) indices into ``stamps_ns`` and (M,) absolute gaps in nanoseconds. The earlier stamp wins a tie.
    """
    right = np.clip(np.searchsorted(stamps_ns, wanted_ns), 1, max(len(stamps_ns) - 1, 1))
    right = np.minimum(right, len(stamps_ns) - 1)
    left = np.maximum(right - 1, 0)
    gap_left, gap_right = np.abs(stamps_ns[left] - wanted_ns), np.abs(stamps_ns[right] - wanted_ns)
    index = np.where(gap_left <= gap_right, left, right)
    return index, np.minimum(gap_left, gap_right)
