"""What a receiver's messages say, and which of them are fixes."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geodesy import GeodeticOrigin
from mapper.core.timebase import NS_PER_S
from mapper.sensing.gnss import NO_FIX, GnssFixes


def fixes(n: int = 20, sigma_m: float = 1.5) -> GnssFixes:
    """Fixes once a second, 10 m apart."""
    points = np.arange(n)[:, None] * [10.0, 0.0, 0.0]
    return GnssFixes(
        "/fix",
        np.arange(n) * NS_PER_S,
        GeodeticOrigin(47.5, 19.0, 120.0).geodetic(points),
        np.tile(np.diag([sigma_m**2, sigma_m**2, 4.0 * sigma_m**2]), (n, 1, 1)),
        np.zeros(n, np.int8),
    )


def test_fixes_without_a_fault_are_all_kept():
    kept, notes = fixes().without_invalid()
    assert len(kept) == 20
    assert notes == []
    assert kept.median_sigma_m == pytest.approx(1.5)


def test_messages_without_a_position_are_counted_by_their_reason():
    messages = fixes()
    messages.status[:3] = NO_FIX
    messages.geodetic[3:5, 0] = np.nan
    messages.geodetic[5, :2] = 0.0
    messages.geodetic[6, 0] = 91.0
    kept, notes = messages.without_invalid()
    assert len(kept) == 13
    assert [note.split(" of ")[0].rpartition(" ")[2] for note in notes] == ["3", "4"]
    messages.status[:] = NO_FIX
    assert messages.without_invalid()[0] is None


@pytest.mark.parametrize(
    "covariance", [np.zeros((3, 3)), -np.eye(3), np.full((3, 3), np.nan), 1e9 * np.eye(3)]
)
def test_an_impossible_covariance_counts_as_none(covariance):
    messages = fixes()
    messages.covariances_enu[:7] = covariance
    kept, notes = messages.without_invalid()
    assert len(notes) == 1
    assert np.isnan(kept.covariances_enu).all(axis=(1, 2)).sum() == 7
    assert kept.median_sigma_m == pytest.approx(1.5)


def test_jumps_that_no_motion_explains_are_counted():
    messages = fixes()
    away = GeodeticOrigin(47.5, 19.0, 120.0).geodetic(np.array([[100.0, 300.0, 0.0]]))
    messages.geodetic[10] = away
    jumps = messages.jumps()
    assert len(jumps) == 2
    assert max(jumps) == pytest.approx(300.2, abs=0.2)
    assert len(messages.without_invalid()[1]) == 1
    apart = replace(messages, stamps_ns=messages.stamps_ns * 10)  # 500 m in 10 s are possible
    assert apart.jumps() == []
