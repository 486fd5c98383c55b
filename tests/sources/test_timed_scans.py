"""Times of a LiDAR's points that the user corrects, leaves out, or has by azimuth."""

import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.sources.config import SourceConfig
from mapper.sources.frame_selection import selected
from mapper.sources.point_times import azimuth_times_s
from tests.support.logs import log_in_memory, memory_entry

COLUMNS, RINGS, SWEEP_S = 360, 4, 0.1
COLUMN_S = np.arange(COLUMNS) * SWEEP_S / COLUMNS


def turn(*, clockwise, first_rad=np.pi, order="columns"):
    """Return the (N, 3) points of a turn, and their times."""
    azimuth = first_rad + (-1.0 if clockwise else 1.0) * 2.0 * np.pi * COLUMN_S / SWEEP_S
    rays = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(COLUMNS)])
    heights = np.array([0.0, 0.0, 1.0]) * np.linspace(-0.3, 0.3, RINGS)[:, None]
    points, times_s = 5.0 * (rays[None] + heights[:, None]), np.tile(COLUMN_S, (RINGS, 1))
    if order == "columns":
        points, times_s = points.swapaxes(0, 1), times_s.T
    return points.reshape(-1, 3), times_s.reshape(-1)


@pytest.mark.parametrize("order", ["columns", "rings"])
@pytest.mark.parametrize("clockwise", [True, False])
@pytest.mark.parametrize("first_rad", [np.pi, 0.3, -2.0])
def test_points_in_the_order_of_measuring_have_times_by_azimuth(order, clockwise, first_rad):
    points, times_s = turn(clockwise=clockwise, first_rad=first_rad, order=order)
    found_s = azimuth_times_s(points.astype(np.float32), np.zeros(3), SWEEP_S)
    # A point of the first column that rounding puts before the first point is taken for the turn's last.
    error_s = np.abs(np.remainder(found_s - times_s + 0.5 * SWEEP_S, SWEEP_S) - 0.5 * SWEEP_S)
    assert error_s.max() < 1e-6


def test_azimuths_are_about_the_origin_of_the_rays():
    points, times_s = turn(clockwise=True)
    origin = np.array([0.7, -0.2, 1.5])
    np.testing.assert_allclose(azimuth_times_s(points + origin, origin, SWEEP_S), times_s, atol=1e-6)


def test_points_in_another_order_have_no_times():
    points, _ = turn(clockwise=True)
    mixed = np.random.default_rng(0).permutation(points)
    assert azimuth_times_s(mixed, np.zeros(3), SWEEP_S) is None
    assert azimuth_times_s(points[:1], np.zeros(3), SWEEP_S) is None


def read(times_s, **settings):
    points, _ = turn(clockwise=True)
    scan = Scan(7, points.astype(np.float32), times_s=times_s)
    log = log_in_memory([memory_entry(7, scan)], sensor="lidar")
    entry = selected(log, SourceConfig(**settings)).entry_at(0)
    np.testing.assert_array_equal(entry.load().points_body, scan.points_body)
    return entry.load().times_s, entry.scan().times_s


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_times_are_scaled(scale):
    times_s = turn(clockwise=True)[1].astype(np.float32)
    for found_s in read(times_s, point_time_scale=scale, sweep_s=0.2):
        np.testing.assert_array_equal(found_s, np.float32(scale) * times_s)


@pytest.mark.parametrize("first_s", [0.0, -0.1])
def test_times_that_count_backwards_begin_at_the_stamp(first_s):
    times_s = turn(clockwise=True)[1].astype(np.float32) + np.float32(first_s)
    for found_s in read(times_s, point_time_scale=-2.0):
        np.testing.assert_allclose(found_s, 2.0 * (times_s.max() - times_s), atol=1e-6)


def test_a_scale_of_zero_leaves_times_out():
    assert read(turn(clockwise=True)[1].astype(np.float32), point_time_scale=0.0) == (None, None)


def test_scans_without_times_get_them_by_the_duration_of_a_turn():
    assert read(None) == (None, None)
    for found_s in read(None, sweep_s=0.2):
        np.testing.assert_allclose(found_s, 2.0 * turn(clockwise=True)[1], atol=1e-6)
