"""Inertial readings beside a log."""

import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.sensing.gyroscope import Gyroscope
from mapper.sources.imu_files import BOTH_HEADER, read_imu, write_gyroscope


def test_a_csv_of_euroc_has_both_readings(tmp_path):
    lines = [BOTH_HEADER, "2000,0.1,0.2,0.3,0,0,9.8", "1000,0.4,0.5,0.6,nan,nan,nan", "3000,nan,0,0,0,0,9.7"]
    (tmp_path / "imu.csv").write_text("\n".join(lines))
    gyroscope, accelerations, notes = read_imu(tmp_path)
    assert gyroscope.stamps_ns.tolist() == [1000, 2000]
    np.testing.assert_array_equal(gyroscope.rates_radps, [[0.4, 0.5, 0.6], [0.1, 0.2, 0.3]])
    assert accelerations.stamps_ns.tolist() == [2000, 3000]
    assert [sum(words in note for note in notes) for words in ("1 places", "1 of 3")] == [1, 2]
    assert len(notes) == 3


def test_angular_velocities_that_are_not_finite_are_counted(tmp_path):
    (tmp_path / "gyroscope.txt").write_text("1 0 0 nan\n2 0 0 0.1\n3 inf 0 0\n4 0 0 0.2\n")
    gyroscope, _, notes = read_imu(tmp_path)
    assert len(gyroscope) == 2
    assert [note for note in notes if "2 of 4" in note]


def test_a_csv_of_another_layout_is_named_and_not_used(tmp_path):
    (tmp_path / "imu.csv").write_text("timestamp, a_x, a_y, a_z\n1,2,3,4\n")
    assert read_imu(tmp_path)[:2] == (None, None)
    (tmp_path / "imu.csv").write_text(f"{BOTH_HEADER}\n1,2,3\n")
    with pytest.raises(SourceError, match=r"imu\.csv: line 2 has 3 columns"):
        read_imu(tmp_path)


def test_angular_velocities_are_read_as_they_were_written(tmp_path):
    rates = np.random.default_rng(1).normal(size=(5, 3))
    write_gyroscope(tmp_path, Gyroscope("/imu", np.arange(5) * 5_000_001, rates))
    gyroscope, accelerations, _ = read_imu(tmp_path)
    np.testing.assert_array_equal(gyroscope.rates_radps, rates)
    assert gyroscope.stamps_ns.tolist() == [k * 5_000_001 for k in range(5)]
    assert accelerations is None
