import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapper.core.errors import DataError
from mapper.core.timebase import (
    nearest,
    ns_from_date_text,
    ns_from_seconds_text,
    seconds_text_from_ns,
    stretches,
)

STAMPS = st.integers(-(10**18), 9 * 10**18)


@given(STAMPS)
def test_any_stamp_survives_the_way_through_text(stamp_ns):
    assert ns_from_seconds_text(seconds_text_from_ns(stamp_ns)) == stamp_ns


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1305031102.175304", 1305031102175304000),
        ("1305031102.175304001", 1305031102175304001),
        ("0", 0),
        ("-0.000000001", -1),
        ("1.5e2", 150_000_000_000),
    ],
)
def test_text_is_parsed_without_a_float(text, stamp_ns):
    assert ns_from_seconds_text(text) == stamp_ns


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("2011-09-26 13:02:25.594360375", 1317042145594360375),
        ("2011-09-26T13:02:25Z", 1317042145000000000),
        ("1970-01-01 00:00:00.5", 500_000_000),
        ("1969-12-31 23:59:59.999999999", -1),
        ("2012-02-29 00:00:00", 1330473600000000000),
    ],
)
def test_dates_are_parsed_to_the_nanosecond(text, stamp_ns):
    assert ns_from_date_text(text) == stamp_ns


@pytest.mark.parametrize(
    "text",
    [
        "2011-09-26",
        "2011-02-30 00:00:00",
        "2011-09-26 25:00:00",
        "26.9.2011 13:02:25",
        "2011-09-26 13:02:25.0000000001",
    ],
)
def test_what_is_no_date_is_refused(text):
    with pytest.raises(DataError, match="is no date and time"):
        ns_from_date_text(text)


@pytest.mark.parametrize(
    ("stamp_ns", "text"),
    [
        (1305031102175304000, "1305031102.175304"),
        (1_000_000_010, "1.00000001"),
        (-1, "-0.000000001"),
        (0, "0.000000"),
    ],
)
def test_stamps_are_written_as_tum_writes_them(stamp_ns, text):
    assert seconds_text_from_ns(stamp_ns) == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("soon", "'soon' is not a decimal number"),
        ("", "'' is not a decimal number"),
        ("nan", "'nan' is not finite"),
        ("-inf", "'-inf' is not finite"),
        ("1e30", "64 bits cannot hold"),
        ("1e999999999999", "64 bits cannot hold"),
    ],
)
def test_what_is_no_stamp_is_refused(text, message):
    with pytest.raises(DataError, match=message):
        ns_from_seconds_text(text)


@given(
    st.lists(st.integers(0, 1000), min_size=1, max_size=20, unique=True).map(sorted),
    st.lists(st.integers(-100, 1100), max_size=20),
)
def test_nearest_agrees_with_looking_at_every_stamp(stamps, wanted):
    index, gap_ns = nearest(np.array(stamps, dtype=np.int64), np.array(wanted, dtype=np.int64))
    for i, gap, want in zip(index, gap_ns, wanted, strict=True):
        gaps = [abs(stamp - want) for stamp in stamps]
        assert gap == min(gaps)
        assert i == gaps.index(min(gaps)), "the earlier stamp wins a tie"


def test_nearest_is_exact_at_the_size_of_the_unix_epoch():
    stamps = 1305031102175304000 + np.array([0, 3, 10])
    index, gap_ns = nearest(stamps, stamps[:1] + 2)
    assert (index.tolist(), gap_ns.tolist()) == ([1], [1])


def test_stretches_reach_to_the_frames_beside_them():
    marked = [True, False, False, True, True, False, True]
    assert stretches(marked) == [(0, 0), (3, 4), (6, 6)]
    assert stretches(np.array(marked), margin=1) == [(0, 1), (2, 5), (5, 6)]
    assert stretches([False] * 5) == stretches([]) == []
