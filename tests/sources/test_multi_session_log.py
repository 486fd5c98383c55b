"""Several logs as one: clocks, truths, and what every frame keeps."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.timebase import NS_PER_S
from mapper.sensing.gnss import GnssFixes
from mapper.sensing.gyroscope import Gyroscope
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.multi_session_log import chained, sessions_of
from tests.support.tum_logs import FIRST_NS, PERIOD_NS


@pytest.fixture
def two(tiny_tum_log):
    """Two logs of the same moments, so that the second has to be shifted."""
    return open_source(tiny_tum_log(4, folder="one")), open_source(tiny_tum_log(3, folder="two"))


def test_a_later_log_keeps_its_clock(tiny_tum_log):
    log = tiny_tum_log(6)
    first, second = (open_source(log, SourceConfig(first_frame=a, last_frame=b)) for a, b in ((0, 3), (4, 5)))
    source = chained(first, second)
    assert source.stamps_ns.tolist() == open_source(log).stamps_ns.tolist()
    assert source.stamps_ns.tolist() == source.stamps_ns.tolist(), "repeatable"
    assert len(source) == 6
    assert [session.shift_ns for session in source.sessions] == [0, 0]
    # The first truth goes on past its log, and yields to the next.
    np.testing.assert_array_equal(source.truth.stamps_ns, open_source(log).truth.stamps_ns)


def test_a_log_that_is_not_later_begins_a_second_after_the_first(two):
    source = chained(*two)
    end_ns = FIRST_NS + 3 * PERIOD_NS
    assert source.stamps_ns.tolist()[4:] == [end_ns + NS_PER_S + i * PERIOD_NS for i in range(3)]
    assert f"two: stamps raised by {source.sessions[1].shift_ns / 1e9:.3f} s" in "; ".join(source.notes)
    last = source.sessions[-1].log
    assert (last.stamps_ns.tolist(), len(last), last.name) == (source.stamps_ns.tolist()[4:], 3, "two")
    np.testing.assert_array_equal(last.truth.stamps_ns, source.truth.stamps_ns[4:])
    assert chained(*two, shift_ns=5 * NS_PER_S).sessions[1].shift_ns == 5 * NS_PER_S


def test_frames_and_scans_are_those_of_the_logs_on_the_common_clock(two):
    second = list(two[1].entries())
    for entry, own in zip(list(chained(*two).entries())[4:], second, strict=True):
        shift_ns = entry.stamp_ns - own.stamp_ns
        frame, own_frame = entry.load(), own.load()
        assert frame.stamp_ns == entry.scan().stamp_ns == entry.stamp_ns
        assert entry.load(colour=False).image.ndim == 2
        np.testing.assert_array_equal(frame.image, own_frame.image)
        np.testing.assert_array_equal(entry.scan().points_body, own.scan().points_body)
        assert entry.files.colour == own.files.colour
        assert entry.depth_stamp_ns == own.depth_stamp_ns + shift_ns


def test_three_logs_follow_one_another(two, tiny_tum_log):
    third = open_source(tiny_tum_log(2, folder="three"))
    source = chained(chained(*two), third)
    assert [session.log.name for session in sessions_of(source)] == ["one", "two", "three"]
    assert source.name == "one + two + three"
    stamps_ns = source.stamps_ns.tolist()
    assert len(source) == 9
    assert stamps_ns == sorted(set(stamps_ns))


def test_truths_are_joined_and_it_is_said(two):
    source = chained(*two)
    np.testing.assert_array_equal(
        source.truth.stamps_ns,
        [*two[0].truth.stamps_ns, *(two[1].truth.stamps_ns + source.sessions[1].shift_ns)],
    )
    np.testing.assert_array_equal(source.truth.T_world_body[4:], two[1].truth.T_world_body)
    assert "the ground truths of one and two are taken to be in one world" in source.notes


def test_the_truth_of_one_log_alone_is_kept_and_it_is_said(tiny_tum_log):
    log = tiny_tum_log(3, folder="two")
    (log / "groundtruth.txt").unlink()
    first = open_source(tiny_tum_log(4, folder="one"))
    source = chained(first, open_source(log))
    np.testing.assert_array_equal(source.truth.stamps_ns, first.truth.stamps_ns)
    assert "ground truth of one only" in source.notes


def test_without_truth_there_is_none(tiny_tum_log):
    logs = [tiny_tum_log(2, folder=name) for name in ("one", "two")]
    for log in logs:
        (log / "groundtruth.txt").unlink()
    source = chained(*map(open_source, logs))
    assert source.truth is None
    assert not any("truth" in note for note in source.notes)


def test_a_single_log_is_one_session(two):
    (session,) = sessions_of(two[0])
    assert session.log is two[0]
    assert [entry.stamp_ns for entry in session.log.entries()] == two[0].stamps_ns.tolist()


def test_calibrated_gyroscopes_follow_one_another(two):
    """Readings go on after the last frame, and begin before the first one."""

    def with_rates(log, *, is_of_body):
        begin_ns, end_ns = log.stamps_ns[[0, -1]]
        stamps_ns = np.arange(begin_ns - NS_PER_S, end_ns + NS_PER_S, 10_000_000)
        rates = np.full((len(stamps_ns), 3), float(len(log)))
        return replace(log, gyroscope=Gyroscope("imu", stamps_ns, rates, is_of_body=is_of_body))

    source = chained(*(with_rates(log, is_of_body=True) for log in two))
    gyroscope = source.gyroscope
    assert gyroscope.is_of_body
    assert (np.diff(gyroscope.stamps_ns) > 0).all()
    for session in source.sessions:
        begin_ns, end_ns = session.log.stamps_ns[[0, -1]]
        inside = (gyroscope.stamps_ns >= begin_ns) & (gyroscope.stamps_ns <= end_ns)
        assert set(gyroscope.rates_radps[inside, 0]) == {float(len(session.log))}
    assert chained(*(with_rates(log, is_of_body=False) for log in two)).gyroscope is None


def test_fixes_of_a_later_session_are_named_and_kept_on_its_clock(two):
    first, second = two
    place = np.array([[47.5, 19.0, 120.0]])
    fixes = GnssFixes("/fix", second.stamps_ns[:1], place, np.eye(3)[None], np.zeros(1, np.int8))
    source = chained(first, replace(second, gnss=fixes))
    assert source.gnss is None
    (session,) = source.sessions[1:]
    assert session.log.gnss.stamps_ns[0] == fixes.stamps_ns[0] + session.shift_ns
    assert sum("GNSS" in note for note in source.notes) == 1
    assert not any("GNSS" in note for note in chained(first, second).notes)
