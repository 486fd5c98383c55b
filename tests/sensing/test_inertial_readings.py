"""Inertial readings between the times of frames."""

import numpy as np
import pytest

from mapper.sensing.inertial import InertialReadings

MS = 1_000_000
STAMPS_NS = np.arange(0, 1000, 5, dtype=np.int64) * MS
READINGS = InertialReadings(
    STAMPS_NS,
    np.column_stack([np.sin(1e-9 * STAMPS_NS), np.ones(200), np.zeros(200)]),
    np.column_stack([np.zeros(200), np.cos(1e-9 * STAMPS_NS), np.full(200, 9.8)]),
    gap_ns=50 * MS,
)


@pytest.mark.parametrize(
    ("begin_ms", "end_ms", "is_covered"),
    [(0, 995, True), (-20, 1015, True), (-30, 500, False), (500, 1025, False)],
)
def test_readings_reach_half_a_gap_beyond_their_ends(begin_ms, end_ms, is_covered):
    assert READINGS.covers(begin_ms * MS, end_ms * MS) == is_covered


def test_the_first_reading_holds_before_it():
    rates, accelerations, seconds = READINGS.between(-20 * MS, 5 * MS)
    assert rates[0] == pytest.approx(READINGS.rates_radps[0])
    assert accelerations[0] == pytest.approx(READINGS.accelerations_mps2[0])
    assert seconds.sum() == pytest.approx(0.025)
