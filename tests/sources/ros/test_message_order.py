import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.sources.ros.message_index import Series
from mapper.sources.ros.message_order import ordered, paired
from mapper.sources.ros.recording import Topic

MS = 1_000_000


def series(stamps_ms, name="/a", undated=0):
    stamps_ns = np.array(stamps_ms, dtype=np.int64) * MS
    return Series(
        Topic(name, "", "cdr"),
        stamps_ns,
        np.arange(len(stamps_ns)) * 100 * MS,
        np.zeros((len(stamps_ns), 3), np.int64),
        undated,
    )


def pairs(color_ms, depth_ms, *, max_gap_s=0.02):
    i, j, notes = paired(series(color_ms), series(depth_ms, "/d"), max_gap_s=max_gap_s, where="log")
    return list(zip(i.tolist(), j.tolist(), strict=True)), notes


@pytest.mark.parametrize(
    ("stamps", "kept", "noted"),
    [
        ([0, 100, 200, 300, 5000, 5100], [0, 1, 2, 3, 4, 5], []),
        (
            [0, 200, 100, 300, 300, 400],
            [0, 2, 1, 3, 5],
            ["out of time order in 1 places; sorted", "1 stamps appear twice; the first was kept"],
        ),
        (
            [0, 100, 600, 200, 300, 400, 500, 700],
            [0, 1, 3, 4, 5, 6, 2, 7],
            ["out of time order in 1 places; sorted"],
        ),
    ],
)
def test_messages_of_which_four_overtook_each_other_are_sorted_and_duplicates_dropped(stamps, kept, noted):
    order, notes = ordered(series(stamps))
    assert order.tolist() == kept
    assert notes == [f"/a: {note}" for note in noted]


def test_stamps_that_cannot_be_right_are_left_out():
    stamps = [100 * i for i in range(20)]
    stamps[7], stamps[12] = 10**12, 3
    order, notes = ordered(series(stamps, undated=2))
    assert order.tolist() == [i for i in range(20) if i not in (7, 12)]
    assert notes == ["/a: 4 of 22 messages have stamps that cannot be right; left out"]


@pytest.mark.parametrize(
    ("stamps", "kept"),
    [
        # ten seconds back: what comes again is left out
        ([*range(0, 20_000, 100), *range(10_000, 30_000, 100)], [*range(200), *range(300, 400)]),
        # half a second back: sorting would mix two places
        ([*range(0, 2_000, 100), *range(1_400, 3_000, 100)], [*range(20), *range(26, 36)]),
        # an hour back for good, after a moment: the longer part is the log
        ([*range(3_600_000, 3_601_000, 100), *range(0, 9_000, 100)], [*range(10, 100)]),
    ],
)
def test_a_clock_that_was_set_back_never_mixes_two_times(stamps, kept):
    order, notes = ordered(series(stamps))
    assert sorted(order.tolist()) == sorted(kept)
    assert (np.diff(np.array(stamps)[order]) > 0).all()
    lost = len(stamps) - len(kept)
    assert [note for note in notes if "set back" in note] == (
        [f"/a: the clock was set back while recording; {lost} of {len(stamps)} frames bear times that other "
         "frames have too; left out"] if lost else []
    )  # fmt: skip


@pytest.mark.parametrize(("jump_ms", "noted"), [(3_600_000, True), (5_000, False)])
def test_a_clock_that_was_set_forward_is_noted(jump_ms, noted):
    order, notes = ordered(series([*range(0, 1_000, 100), *range(1_000 + jump_ms, 2_000 + jump_ms, 100)]))
    assert len(order) == 20
    assert [f"{jump_ms / 1e3:.1f} s" in note and "message 10" in note for note in notes] == [True] * noted


def test_each_colour_image_gets_its_nearest_depth():
    found, notes = pairs([0, 33, 67, 100], [5, 40, 60, 190])
    assert found == [(0, 0), (1, 1), (2, 2)]
    assert notes == ["1 of 4 colour images have no depth image within 20 ms; left out"]


def test_images_of_two_times_with_the_same_stamp_are_not_paired():
    """The clock is set back by two seconds, and depth stops just then."""
    before, again = [100 * i for i in range(50)], [100 * i for i in range(30, 80)]
    found, _ = pairs([*before, *again], before)
    assert found == [(i, i) for i in range(50)]
    found, notes = pairs([*before, *again], [*before, *again])
    assert found == [*((i, i) for i in range(50)), *((i, i) for i in range(70, 100))]
    assert any("20 of 100 frames bear times" in note for note in notes)


def test_a_topic_that_stops_is_told():
    found, notes = pairs(range(0, 10_000, 100), range(0, 4_000, 100))
    assert len(found) == 40
    assert notes == [
        "60 of 100 colour images have no depth image within 20 ms; "
        "more than half of the log is left out (source.max_pair_gap_s)",
        "/d stops 6.0 s before /a",
    ]
    assert pairs(range(0, 4_000, 100), range(0, 10_000, 100))[1] == ["/a stops 6.0 s before /d"]


def test_nothing_that_pairs_is_an_error():
    with pytest.raises(SourceError, match=r"no image of /a .* within 20 ms; the closest are 0.05 s"):
        pairs([0, 100], [50, 150])
    assert pairs([0, 100], [50, 150], max_gap_s=0.05)[0] == [(0, 0), (1, 0)]


@pytest.mark.parametrize(("early_ms", "noted"), [(500, 1), (200, 0)])
def test_depth_whose_stamps_are_off_by_the_times_of_recording_is_told(early_ms, noted):
    found, notes = pairs(range(1000, 5000, 100), range(1000 - early_ms, 5000 - early_ms, 100))
    assert len(found) == 40 - early_ms // 100
    assert sum(f"source.depth_offset_s={early_ms / 1e3:g}" in note for note in notes) == noted
