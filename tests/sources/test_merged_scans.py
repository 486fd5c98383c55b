"""Scans of several LiDARs that are tracked as one."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.core.geometry import apply, inverse, rotation_exp, transform
from mapper.evaluators.metrics.trajectory_errors import ate_rmse_m
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.simulation.config import LidarSensorConfig, LidarSynthConfig
from mapper.simulation.lidar import LidarSimulator
from mapper.sources.base import SensorBeside
from mapper.sources.config import SourceConfig
from mapper.sources.frame_selection import selected
from mapper.sources.merged_scans import with_merged_scans, with_whole_turns
from mapper.sources.reading_checks import ReadingChecks
from tests.support.logs import changed_frames, log_in_memory, memory_entry

MS = 1_000_000
T_BODY_REAR = transform(rotation_exp(np.array([0.0, 0.0, np.pi])), np.array([-1.0, 0.0, 0.0]))


def scans(*stamps_ms, times_s=None):
    """A log of scans of two points, whose x is the scan's time in milliseconds."""
    entries = []
    for at in stamps_ms:
        points = np.array([[at, 0.0, 0.0], [at, 1.0, 0.0]], np.float32)
        times = None if times_s is None else np.array(times_s, np.float32)
        entries.append(memory_entry(at * MS, Scan(at * MS, points, times_s=times)))
    return log_in_memory(entries, sensor="lidar")


def merged(log, *others):
    return with_merged_scans(replace(log, beside=[SensorBeside(one, T_BODY_REAR) for one in others]))


def test_points_are_moved_to_the_body_and_keep_their_times():
    both = merged(scans(0, 100, times_s=(0.0, 0.1)), scans(30, 130, times_s=(-0.1, 0.0))).entry_at(1).load()
    assert both.stamp_ns == 100 * MS
    assert both.points_body == pytest.approx(
        np.array([[100.0, 0.0, 0.0], [100.0, 1.0, 0.0], [-131.0, 0.0, 0.0], [-131.0, -1.0, 0.0]]), abs=1e-4
    )
    assert both.times_s == pytest.approx([0.0, 0.1, -0.07, 0.03], abs=1e-6)


@pytest.mark.parametrize(
    ("others_ms", "taken_ms"),
    [
        ([10, 60, 110, 160], [10, 110]),  # twice as fast: the nearest
        ([90], [None, 90]),
        ([151, 300], [None, None]),  # too far away
        ([45, 55], [45, 55]),
    ],
)
def test_each_scan_is_in_the_nearest_alone(others_ms, taken_ms):
    log = merged(scans(0, 100), scans(*others_ms))
    taken = [frame.points_body[2:, 0] for frame in log]
    assert [None if not len(x) else round(-x[0] - 1.0) for x in taken] == taken_ms


def test_three_sensors_and_a_scan_that_cannot_be_read():
    damaged = log_in_memory(
        [memory_entry(0, FrameError("damaged")), *map(scans(100).entry_at, [0])], sensor="lidar"
    )
    log = merged(scans(0, 100), scans(0, 100), damaged)
    assert [len(frame.points_body) for frame in log] == [4, 6]


@pytest.mark.parametrize("facts", [{"sensor": "rgbd"}, {"sensor": "lidar-2d"}, {"beside": []}])
def test_other_logs_stay_as_they_are(facts):
    log = replace(scans(0, 100), **({"beside": [SensorBeside(scans(0), np.eye(4))]} | facts))
    assert with_merged_scans(log) is log


def narrow_view(T_body_sensor, _index, scan):
    """The part of a scan that a LiDAR with a view of 70° sees, in the frame of that LiDAR."""
    points = apply(inverse(T_body_sensor), scan.points_body.astype(np.float64)).astype(np.float32)
    azimuth_rad = np.arctan2(points[:, 1], points[:, 0])
    return replace(scan, points_body=points).select(np.abs(azimuth_rad) < np.radians(35.0))


def test_two_narrow_views_track_better_than_one():
    sensor = LidarSensorConfig(rings=24, azimuth_steps=600)
    whole = LidarSimulator(LidarSynthConfig(seed=6, loop_m=60.0, duration_s=6.0, sensor=sensor)).log()
    front, rear = (changed_frames(whole, partial(narrow_view, T)) for T in (np.eye(4), T_BODY_REAR))
    log = replace(front, beside=[SensorBeside(rear, T_BODY_REAR)])

    def error_m(others):
        config = load_config(None, [f"source.topics.others={others}", "loops.kind=none"], sensor="lidar")
        tracked = track_log(log, config, progress=SILENT).tracked_trajectory()
        return ate_rmse_m(tracked, log.truth), len(tracked)

    (both_m, both), (front_m, alone) = error_m("tracked"), error_m("fused")
    assert both == len(log) > alone
    assert both_m < 0.7 * front_m


def test_a_frozen_sensor_is_noticed_beside_one_that_is_not():
    frozen = scans(*range(0, 800, 100))
    entries = [
        memory_entry(entry.stamp_ns, replace(frozen[0], stamp_ns=entry.stamp_ns))
        for entry in frozen.entries()
    ]
    checks = ReadingChecks(log_in_memory(entries, sensor="lidar"))
    log = merged(checks.log, scans(*range(0, 800, 100)))
    assert {len(frame.points_body) for frame in log} == {4}
    assert checks.repeated("scan", fewest=3) == [range(8)]


def parts_of(log, count, *, timed):
    """The same scans in parts of a turn that are published one by one."""
    entries = []
    for scan in log:
        part = np.minimum(scan.times_s * count / 0.1, count - 1).astype(int)
        for k in range(count):
            late_ns = k * 100 * MS // count
            times_s = scan.times_s - np.float32(late_ns / 1e9) if timed else None
            cut = replace(scan, stamp_ns=scan.stamp_ns + late_ns, times_s=times_s).select(part == k)
            entries.append(memory_entry(cut.stamp_ns, cut))
    return log_in_memory(entries, sensor="lidar")


@pytest.mark.parametrize(("count", "timed"), [(2, True), (4, True), (4, False), (75, True)])
def test_parts_of_turns_are_joined_to_whole_ones(count, timed):
    sensor = LidarSensorConfig(rings=8, azimuth_steps=600)
    whole = LidarSimulator(LidarSynthConfig(seed=6, loop_m=60.0, duration_s=1.0, sensor=sensor)).log()
    joined = selected(parts_of(whole, count, timed=timed), SourceConfig())
    assert len(joined.notes) == 1
    np.testing.assert_array_equal(joined.stamps_ns, whole.stamps_ns)
    for found, wanted in zip(joined, whole, strict=True):
        assert len(found.points_body) == len(wanted.points_body)
        within_s = 1e-6 if timed else 0.1 / count
        assert np.abs(np.sort(found.times_s) - np.sort(wanted.times_s)).max() < within_s
    half = whole.subset(np.arange(0, len(whole), 2))
    assert with_whole_turns(half) is half


def test_parts_without_returns_belong_to_their_turn_and_damaged_ones_cost_it():
    sensor = LidarSensorConfig(rings=8, azimuth_steps=600)
    whole = LidarSimulator(LidarSynthConfig(seed=6, loop_m=60.0, duration_s=1.0, sensor=sensor)).log()
    parts = parts_of(whole, 12, timed=True)
    entries = [parts.entry_at(k) for k in range(len(parts))]
    for k in (0, 5):
        seen = entries[k].load()
        entries[k] = memory_entry(seen.stamp_ns, seen.select(np.zeros(len(seen.points_body), bool)))
    entries[17] = memory_entry(entries[17].stamp_ns, FrameError("damaged"))
    joined = with_whole_turns(log_in_memory(entries, sensor="lidar"))
    np.testing.assert_array_equal(joined.stamps_ns, whole.stamps_ns)
    assert 0 < len(joined.entry_at(0).scan().points_body) < len(whole.entry_at(0).scan().points_body)
    with pytest.raises(FrameError):
        joined.entry_at(1).load()


def test_views_of_one_direction_are_no_parts_of_turns():
    sensor = LidarSensorConfig(rings=8, azimuth_steps=600)
    whole = LidarSimulator(LidarSynthConfig(seed=6, loop_m=60.0, duration_s=2.0, sensor=sensor)).log()
    front = changed_frames(whole, partial(narrow_view, np.eye(4)))
    assert with_whole_turns(front) is front


def test_a_view_that_a_pan_unit_turns_stays_a_scan_of_its_own():
    angles_rad = np.linspace(-0.5, 0.5, 50)
    entries = []
    for k in range(20):  # at 10 Hz, a turn in a second
        direction_rad = angles_rad + 0.2 * np.pi * k
        points = np.column_stack([np.cos(direction_rad), np.sin(direction_rad), 0.0 * direction_rad])
        entries.append(memory_entry(100 * k * MS, Scan(100 * k * MS, points.astype(np.float32))))
    log = log_in_memory(entries, sensor="lidar")
    assert with_whole_turns(log) is log
    faster = log_in_memory(
        [memory_entry(k * 10 * MS, e.load()) for k, e in enumerate(entries)], sensor="lidar"
    )
    assert len(with_whole_turns(faster)) == 2
