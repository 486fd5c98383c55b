"""Loops between parts of a path that the sensor cannot have reached."""

import numpy as np
import pytest

from mapper.core.geometry import exp
from mapper.loops.closure import LoopClosure
from mapper.loops.reach_gate import checked_reach

SECOND_NS = 1_000_000_000


def moved(x_m):
    return exp(np.zeros(3), np.array([x_m, 0.0, 0.0]))


def checked(*, speed_m_s, gap_s, parts=([0, 1, 2], [3, 4, 5])):
    """Check a loop that places a part, which begins after a gap, 8 m behind where the other begins."""
    poses = {node: moved(speed_m_s * (node % 3)) for node in range(6)}
    stamps_ns = {node: node * SECOND_NS + (node > 2) * round((gap_s - 1.0) * SECOND_NS) for node in range(6)}
    loop = LoopClosure(
        0, 3, stamps_ns[0], stamps_ns[3], "places", "accepted", T_i_j=moved(-8.0), information=np.eye(6)
    )
    return checked_reach(loop, parts, poses, stamps_ns)


@pytest.mark.parametrize(
    ("speed_m_s", "gap_s", "verdict"),
    [(0.5, 3.0, "rejected"), (0.5, 30.0, "accepted"), (2.0, 3.0, "accepted")],
)
def test_a_part_is_no_farther_away_than_the_sensor_moves_meanwhile(speed_m_s, gap_s, verdict):
    found = checked(speed_m_s=speed_m_s, gap_s=gap_s)
    assert found.verdict == verdict
    assert found.reason.startswith("reach: " if verdict == "rejected" else "")


def test_a_part_of_unknown_time_may_lie_anywhere():
    assert checked(speed_m_s=0.5, gap_s=3.0, parts=([], [3, 4, 5])).verdict == "accepted"


def test_parts_that_overlap_in_time_are_compared_where_they_alternate():
    interleaved = ([0, 1, 4], [2, 3, 5])
    assert checked(speed_m_s=0.5, gap_s=3.0, parts=interleaved).verdict == "rejected"
