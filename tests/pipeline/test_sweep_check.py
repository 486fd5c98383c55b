"""Whether a LiDAR's points have the right times, by how its sweeps fit each other."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.deskew import deskewed, twist_between
from mapper.core.doubts import Doubt
from mapper.core.frames import Scan
from mapper.odometry.base import Diagnostics, FrameResult
from mapper.pipeline.sweep_check import sweep_warnings
from mapper.simulation.config import LIDAR_SCENES
from mapper.simulation.lidar.source import LidarSimulator
from mapper.sources.config import SourceConfig
from mapper.sources.selection import selected
from tests.support.logs import MemoryEntry

FLAT = LIDAR_SCENES["flat"].model_copy(
    update={"seed": 1, "duration_s": 6.0, "yaw_swing_rad": 0.6, "speed_mps": 1.2}
)

LIDAR = load_config(None, [], sensor="lidar")


@cache
def scans(*, motion_distortion=True):
    """Return a log in rooms, with every scan simulated once."""
    sensor = FLAT.sensor.model_copy(update={"motion_distortion": motion_distortion, "azimuth_steps": 600})
    log = LidarSimulator(FLAT.model_copy(update={"sensor": sensor})).log()
    kept = [entry.load() for entry in log.entries()]
    return replace(log, entry_at=lambda index: MemoryEntry(kept[index].stamp_ns, kept[index]))


def changed(log, change):
    """Return a log whose scans are those of another after a change, a function of scan and index."""
    return replace(
        log,
        entry_at=lambda index: MemoryEntry(
            int(log.stamps_ns[index]), change(log.entry_at(index).load(), index)
        ),
    )


def tracks(log, **facts):
    """Return results of tracking with the true poses."""
    diagnostics = Diagnostics(0, 0, 0, 0.0, "m", "map", facts.pop("unobservable", ""))
    return [
        FrameResult(int(stamp_ns), index, np.eye(4), T, True, diagnostics, **facts)
        for index, (stamp_ns, T) in enumerate(zip(log.stamps_ns, log.truth.T_world_body, strict=True))
    ]


def warnings(log, **facts):
    return sweep_warnings(log, tracks(log, **facts), LIDAR)


def value_of(warning, name):
    """Return the value of the setting that a warning suggests."""
    assert warning.suggestion.startswith(f"--set {name}=")
    return float(warning.suggestion.partition("=")[2])


def without_times(scan, _):
    return replace(scan, times_s=None)


def backwards(scan, _):
    return replace(scan, times_s=-scan.times_s)


def in_another_unit(scan, _):
    return replace(scan, times_s=2.5 * scan.times_s)


def shares_of_a_sweep(scan, _):
    return replace(scan, times_s=10.0 * scan.times_s)


def deskewed_already(scan, index):
    """Return the scan without its motion, but with the times that it had."""
    truth = scans().truth
    first = max(index - 1, 0)
    last = min(index + 1, len(truth) - 1)
    elapsed_s = float(truth.stamps_ns[last] - truth.stamps_ns[first]) / 1e9
    twist = twist_between(truth.T_world_body[first], truth.T_world_body[last], duration_s=elapsed_s)
    return Scan(scan.stamp_ns, deskewed(scan, twist).points_body, times_s=scan.times_s)


def test_right_times_are_no_doubt():
    assert warnings(scans()) == []
    assert warnings(scans(motion_distortion=False)) == []


@pytest.mark.parametrize(
    ("change", "suggestion", "said"),
    [
        (deskewed_already, "source.point_time_scale=0", "deskewed already"),
        (backwards, "source.point_time_scale=-1", "count backwards"),
        (in_another_unit, "source.point_time_scale=0.4", "another unit"),
        (without_times, "source.sweep_s=0.1", "points have no times, but scans are bent"),
    ],
)
def test_wrong_times_are_a_doubt_whose_remedy_settles_it(change, suggestion, said):
    log = changed(scans(), change)
    (warning,) = warnings(log)
    assert (warning.kind, warning.weight) == ("sweep", "doubt")
    name, wanted = suggestion.split("=")
    value = value_of(warning, name)
    assert value == pytest.approx(float(wanted), abs=0.15 * abs(float(wanted)))
    assert said in warning.sentence
    assert warnings(selected(log, SourceConfig(**{name.removeprefix("source."): value}))) == []


def test_sweeps_longer_than_from_scan_to_scan_are_a_doubt():
    log = changed(scans(), shares_of_a_sweep)
    (warning,) = warnings(log)
    assert "within 1 s by their times, but scans are 0.2 s apart" in warning.sentence
    assert warning.suggestion == "--set source.point_time_scale=0.2"
    half = selected(log, SourceConfig(point_time_scale=0.2))
    config = load_config(None, ["source.point_time_scale=0.2"], sensor="lidar")
    (warning,) = sweep_warnings(half, tracks(half), config)  # the sweeps last but half of the interval
    assert value_of(warning, "source.point_time_scale") == pytest.approx(0.1, abs=0.015)


def test_a_wrong_duration_of_turns_is_corrected():
    log = changed(scans(), without_times)
    config = load_config(None, ["source.sweep_s=0.2"], sensor="lidar")
    (warning,) = sweep_warnings(selected(log, config.source), tracks(log), config)
    assert value_of(warning, "source.sweep_s") == pytest.approx(0.1, abs=0.015)


def test_nothing_is_said_where_poses_or_the_order_of_points_tell_nothing():
    bent = changed(scans(), backwards)
    assert warnings(bent, doubts=(Doubt("jump", "jump"),)) == []
    assert warnings(bent, unobservable="translation along x") == []
    assert sweep_warnings(bent, tracks(bent)[:4], LIDAR) == []
    assert (
        sweep_warnings(bent, tracks(bent), load_config(None, ["odometry.kind=given"], sensor="lidar")) == []
    )
    rng = np.random.default_rng(0)
    mixed = changed(scans(), lambda scan, _: Scan(scan.stamp_ns, rng.permutation(scan.points_body)))
    assert warnings(mixed) == []
