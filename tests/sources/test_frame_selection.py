import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapper.core.errors import SourceError
from mapper.sources import open_source
from mapper.sources.config import SourceConfig


def indices_of(source, everything):
    stamps = [entry.stamp_ns for entry in everything.entries()]
    return [stamps.index(entry.stamp_ns) for entry in source.entries()]


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(first=st.integers(0, 9), last=st.one_of(st.none(), st.integers(0, 12)), stride=st.integers(1, 5))
def test_selects_like_a_slice(tiny_tum_log, first, last, stride):
    log = tiny_tum_log(7)
    want = list(range(7))[first : None if last is None else last + 1 : stride]
    config = SourceConfig(first_frame=first, last_frame=last, stride=stride)
    if not want:
        with pytest.raises(SourceError, match=r"the log has 7 frames, 0 … 6"):
            open_source(log, config)
        return
    source = open_source(log, config)
    assert indices_of(source, open_source(log)) == want
    assert len(source) == len(want)
    assert indices_of(source, open_source(log)) == want, "repeatable"


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"first_frame": 9}, r"range 9 … end; the log has 3 frames"),
        ({"first_frame": 2, "last_frame": 1}, r"range 2 … 1; the log has 3 frames"),
        ({"require_truth": True}, r"ground truth is required .*the log has none"),
    ],
)
def test_a_choice_that_leaves_nothing_is_refused(tiny_tum_log, settings, why):
    log = tiny_tum_log(3)
    (log / "groundtruth.txt").unlink()
    with pytest.raises(SourceError, match=why):
        open_source(log, SourceConfig(**settings))


def test_drops_frames_without_truth_and_counts_them(tiny_tum_log):
    log = tiny_tum_log(6)
    truth = log / "groundtruth.txt"
    truth.write_text("\n".join(truth.read_text().splitlines()[:-2]))
    config = SourceConfig(first_frame=1, require_truth=True)
    source = open_source(log, config)
    assert indices_of(source, open_source(log)) == [1, 2, 3]
    assert source.notes == ["2 frames have no ground truth within 20 ms; left out", "3 of 6 frames selected"]
    with pytest.raises(SourceError, match="no selected frame has ground truth within 20 ms"):
        open_source(log, SourceConfig(first_frame=5, require_truth=True))
    lenient = SourceConfig(first_frame=1, require_truth=True, max_truth_gap_s=60.0)
    assert indices_of(open_source(log, lenient), open_source(log)) == [1, 2, 3, 4, 5]
