"""Inertial readings beside a log."""

import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.sensing.gyroscope import Gyroscope
from mapper.sources.imu_files import BOTH_HEADER, accelerations_of, read_imu, write_gyroscope


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


def test_accelerations_that_no_unit_measures_are_counted(tmp_path):
    rows = [f"{k} 0 0 0.1 0 0 {-1e300 if k == 2 else 9.8:g}" for k in range(1, 6)]
    (tmp_path / "imu.txt").write_text("\n".join(rows))
    gyroscope, accelerations, notes = read_imu(tmp_path)
    assert (len(gyroscope), len(accelerations.stamps_ns)) == (5, 4)
    assert [note for note in notes if "1 of 5" in note]


RATES, FELT = [0.1, -0.2, 0.3], [0.5, 0.0, 9.8]
IN_DEGREES = "time [s]\tgyro_x [deg/s]\tgyro_y [deg/s]\tgyro_z [deg/s]\tacc_x [g]\tacc_y [g]\tacc_z [g]"


@pytest.mark.parametrize("name", ["imu.csv", "imu.txt", "imu_data.csv"])
@pytest.mark.parametrize(
    ("header", "columns"),
    [
        ("timestamp,gx,gy,gz,ax,ay,az", [*RATES, *FELT]),
        ("# t ax ay az wx wy wz", [*FELT, *RATES]),
        ("time,qx,qy,qz,qw,angular_velocity_x,angular_velocity_y,angular_velocity_z,linear_acceleration_x,"
         "linear_acceleration_y,linear_acceleration_z", [0, 0, 0, 1, *RATES, *FELT]),
        ("timestamp;accel_x;accel_y;accel_z;gyro_x;gyro_y;gyro_z;mag_x", [*FELT, *RATES, 40]),
        (IN_DEGREES, [*np.degrees(RATES), *(np.array(FELT) / 9.80665)]),
        ("", [*RATES, *FELT]),
        ("", [*FELT, *RATES]),
    ],
)  # fmt: skip
def test_columns_are_found_by_their_names_or_by_gravity(tmp_path, name, header, columns):
    separator = next((one for one in ";\t," if one in header), " ")
    rows = [[f"{1_700_000_000 + k}.5", *(f"{value:.9g}" for value in columns)] for k in range(3)]
    (tmp_path / name).write_text("\n".join([header, *(separator.join(row) for row in rows)]))
    gyroscope, accelerations, _ = read_imu(tmp_path)
    assert gyroscope.stamps_ns.tolist() == [(1_700_000_000 + k) * 10**9 + 500_000_000 for k in range(3)]
    np.testing.assert_allclose(gyroscope.rates_radps, np.tile(RATES, (3, 1)), atol=1e-6)
    np.testing.assert_allclose(accelerations.acceleration_mps2, np.tile(FELT, (3, 1)), rtol=1e-3)


@pytest.mark.parametrize("unit_mps2", [1.0, 9.80665])
@pytest.mark.parametrize("shaken_mps2", [0.05, 1.0, 3.0, 6.0])
def test_accelerations_without_gravity_are_not_used(shaken_mps2, unit_mps2):
    shaken = np.random.default_rng(3).normal(0.0, shaken_mps2, (400, 3))
    stamps_ns = np.arange(400) * 5_000_000
    felt, _ = accelerations_of("imu", stamps_ns, (shaken + np.array([0.0, 0.0, 9.8])) / unit_mps2)
    assert len(felt.stamps_ns) == 400
    for accelerations in (shaken / unit_mps2, shaken * 0.0):
        felt, notes = accelerations_of("imu", stamps_ns, accelerations)
        assert felt is None
        assert sum("gravity" in note for note in notes) == 1


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
