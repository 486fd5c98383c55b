"""Scans in the frame of a map: told from those around the sensor by their content."""

import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.sources.scan_frame import scan_frame_warnings, sweep_warnings
from tests.support.logs import log_in_memory

ROOM = np.array([[-6.0, -5.0, 0.0], [30.0, 5.0, 3.0]])
PILLARS = [np.array([[x, y, 0.0], [x + 0.6, y + 0.6, 3.0]]) for x in range(-4, 29, 4) for y in (-3, 2)]


class ScanEntry:
    def __init__(self, scan):
        self.stamp_ns, self._scan = scan.stamp_ns, scan

    def scan(self):
        return self._scan


def crossings(origin, rays, box):
    """Return how far along rays a box begins and ends."""
    with np.errstate(divide="ignore"):
        ends = (box[:, None] - origin) / rays
    return ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)


def room_seen_from(origin, *, seed, pillars=PILLARS):
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(0, 360, 0.5)), np.radians(np.arange(-15.0, 16.0, 2.0))
    )
    rays = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    rays += 1e-9
    ranges_m = crossings(origin, rays, ROOM)[1]
    for pillar in pillars:
        begin, end = crossings(origin, rays, pillar)
        ranges_m = np.where((begin < end) & (begin > 0.0), np.minimum(ranges_m, begin), ranges_m)
    return rays * (ranges_m + np.random.default_rng(seed).normal(0.0, 0.01, len(rays)))[:, None]


@pytest.mark.parametrize(
    ("moves", "in_map", "is_found"), [(True, True, True), (True, False, False), (False, False, False)]
)
def test_scans_in_a_map_are_told_by_surfaces_that_stay_while_the_view_moves(moves, in_map, is_found):
    entries = []
    for k in range(12):
        origin = np.array([1.5 * k * moves, 0.4, 1.2])
        points = room_seen_from(origin, seed=k) + (origin if in_map else 0.0)
        entries.append(ScanEntry(Scan(k * 10**8, points.astype(np.float32))))

    assert len(scan_frame_warnings(log_in_memory(entries, sensor="lidar"))) == is_found


@pytest.mark.parametrize("in_map", [True, False])
def test_a_map_that_begins_at_the_sensor_is_told_where_little_stands_before_other_things(in_map):
    entries = []
    for k in range(12):
        origin = np.array([1.0 * k, 0.4, 1.2])
        points = room_seen_from(origin, seed=k, pillars=PILLARS[::6]) + np.array([1.0 * k, 0.0, 0.0]) * in_map
        entries.append(ScanEntry(Scan(k * 10**8, points.astype(np.float32))))

    assert len(scan_frame_warnings(log_in_memory(entries, sensor="lidar"))) == in_map


def test_images_and_single_scans_have_no_frame_to_doubt():
    scan = ScanEntry(Scan(0, room_seen_from(np.array([0.0, 0.4, 1.2]), seed=0).astype(np.float32)))

    assert scan_frame_warnings(log_in_memory([scan], sensor="lidar")) == []
    assert scan_frame_warnings(log_in_memory([scan] * 5, sensor="rgbd")) == []


@pytest.mark.parametrize(("sweep_s", "is_told"), [(0.1, False), (0.3, False), (1.0, True)])
def test_times_of_points_that_last_longer_than_scans_take_are_told_with_the_scale(sweep_s, is_told):
    times_s = np.linspace(0.0, sweep_s, 50, dtype=np.float32)
    scans = [Scan(k * 10**8, np.ones((50, 3), np.float32), times_s=times_s) for k in range(5)]
    log = log_in_memory([ScanEntry(scan) for scan in scans], sensor="lidar")
    told = sweep_warnings(log)
    assert ["point_time_scale=0.1 " in sentence for sentence in told] == [True] * is_told
    assert sweep_warnings(log[:1]) == []


@pytest.mark.parametrize(("times", "is_told"), [(1, False), (2, True), (3, True), (40, False)])
def test_scans_at_several_stamps_each_are_told_with_the_stride(times, is_told):
    seen = [np.random.default_rng(k).normal(0.0, 5.0, (50, 3)).astype(np.float32) for k in range(40)]
    scans = [Scan(k * 10**8, points) for k, points in enumerate(np.repeat(seen, times, axis=0)[:40])]
    log = log_in_memory([ScanEntry(scan) for scan in scans], sensor="lidar")
    assert [f"stride={times} " in sentence for sentence in sweep_warnings(log)] == [True] * is_told
    assert sweep_warnings(log[::times]) == []
