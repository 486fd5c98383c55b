"""Readings in files beside a log's frames: used by the frames' time, or named."""

import re
from dataclasses import replace

import numpy as np
import pytest

from mapper.core.timebase import NS_PER_S, seconds_text_from_ns
from mapper.core.trajectory import Trajectory
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.imu_files import BOTH_HEADER
from mapper.sources.writers import write_log
from tests.support.tum_logs import FIRST_NS

OTHER_YEAR_NS = FIRST_NS - 40_000_000 * NS_PER_S


def write_imu(folder, first_ns, *, unit_ns=1):
    stamps = (first_ns + np.arange(40) * 5_000_000) // unit_ns
    (folder / "imu.csv").write_text(
        "\n".join([BOTH_HEADER, *(f"{stamp},0.1,0.2,0.3,0.0,0.0,9.8" for stamp in stamps)])
    )


def write_wheels(folder, first_ns, *, step_m):
    lines = [f"{seconds_text_from_ns(first_ns + k * 20_000_000)} {k * step_m} 0 0 0 0 0 1" for k in range(10)]
    (folder / "wheels.txt").write_text("\n".join(lines))


def write_gnss(folder, first_ns, **_):
    lines = [f"{seconds_text_from_ns(first_ns + k * 50_000_000)} 48.1 11.5 500.0 0" for k in range(5)]
    (folder / "gnss.txt").write_text("\n".join(lines))


@pytest.mark.parametrize(("unit", "unit_ns"), [("µs", 1_000), ("ms", 1_000_000)])
def test_stamps_of_another_unit_are_converted_and_named(tiny_tum_log, unit, unit_ns):
    folder = tiny_tum_log(3)
    write_imu(folder, FIRST_NS, unit_ns=unit_ns)
    log = open_source(folder)
    for readings in (log.gyroscope, log.accelerations):
        assert abs(readings.stamps_ns[0] - FIRST_NS) < unit_ns
        assert np.diff(readings.stamps_ns).max() < 6_000_000
    assert sum(f"taken in {unit}" in note for note in log.notes) == 2


@pytest.mark.parametrize(
    ("write", "kinds"), [(write_imu, 2), (write_gnss, 1), (lambda *a: write_wheels(*a, step_m=0.01), 1)]
)
@pytest.mark.parametrize("first_ns", [FIRST_NS, OTHER_YEAR_NS])
def test_readings_of_another_time_are_named_and_not_used(tiny_tum_log, write, kinds, first_ns):
    folder = tiny_tum_log(3)
    write(folder, first_ns)
    log = open_source(folder)
    used = [one for one in (log.wheels, log.gyroscope, log.accelerations, log.gnss) if one is not None]
    named = sum("none is of their time" in note for note in log.notes)
    assert (len(used), named) == ((kinds, 0) if first_ns == FIRST_NS else (0, kinds))


@pytest.mark.parametrize("first_ns", [0, OTHER_YEAR_NS])
def test_poses_and_readings_of_another_clock_name_the_setting_that_moves_them(tiny_tum_log, first_ns):
    folder = tiny_tum_log(3)
    write_imu(folder, first_ns)
    write_wheels(folder, first_ns, step_m=0.01)
    poses = [f"{seconds_text_from_ns(first_ns + k * 10**8)} {k} 0 0 0 0 0 1" for k in range(3)]
    (folder / "groundtruth.txt").write_text("\n".join(poses))
    log = open_source(folder)
    assert (log.truth, log.wheels, log.gyroscope, log.accelerations) == (None, None, None, None)
    stated = re.findall(r"source\.(\w+_offset_s)=([\d.]+)", " ".join(log.notes))
    assert len(stated) == 4
    moved = open_source(folder, SourceConfig(**{name: float(offset_s) for name, offset_s in stated}))
    for readings in (moved.truth, moved.wheels, moved.gyroscope, moved.accelerations):
        assert abs(readings.stamps_ns[0] - FIRST_NS) <= 2_000_000


def test_wheels_that_stand_still_are_not_used(tiny_tum_log):
    folder = tiny_tum_log(3)
    write_wheels(folder, FIRST_NS, step_m=0.0)
    log = open_source(folder)
    assert log.wheels is None
    assert not any("wheels.txt" in choice for choice in log.choices)
    assert sum("stands still" in note for note in log.notes) == 1


def test_wheels_of_a_recording_that_stand_still_are_not_used(tiny_tum_log, tmp_path):
    log = open_source(tiny_tum_log(3))
    still = Trajectory(log.stamps_ns, np.repeat(np.eye(4)[None], len(log), axis=0))
    assert write_log(replace(log, wheels=still), tmp_path / "log.mcap", kind="mcap") == []
    again = open_source(tmp_path / "log.mcap")
    assert again.wheels is None
    assert sum("stands still" in note for note in again.notes) == 1
