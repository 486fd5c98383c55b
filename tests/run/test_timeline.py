"""Where in a log its frames lie."""

import numpy as np

from mapper.run.timeline import TimeLine


def test_a_place_is_told_in_seconds_of_the_log_once_if_both_ends_round_to_one():
    line = TimeLine(5_000_000_000 + np.array([0, 40, 1_020, 2_000], np.int64) * 1_000_000, 4e7, ())
    assert line.place(0, 3) == "0.0 … 2.0 s"
    assert line.place(2, 2) == "1.0 s"
    assert line.place(0, 1) == "0.0 s"
