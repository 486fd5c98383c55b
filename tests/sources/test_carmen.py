"""CARMEN's text logs: beams, mounting, wheels and damaged lines."""

import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.sources import open_source
from tests.support.planar_drives import SICK, Drive, drive, flat, write_carmen


@pytest.fixture(scope="module")
def driven() -> Drive:
    return drive(flat(), SICK, speed_mps=0.8).part(30)


def opened(path, readings, *, message="FLASER", poses="0 0 0 0 0 0"):
    """Write four messages of the same readings, and open the log of them."""
    head = f"{message} {len(readings)} {' '.join(readings)} {poses}"
    path.write_text("\n".join(f"{head} {k}.0 host {k}.0" for k in range(1, 5)))
    return open_source(path)


@pytest.mark.parametrize("message", ["FLASER", "ROBOTLASER1"])
def test_returns_lie_where_the_beams_met_walls_and_wheels_are_the_odometry(tmp_path, driven, message):
    log = open_source(write_carmen(tmp_path / "run.log", driven, message=message))

    assert (log.sensor, log.kind, len(log)) == ("lidar-2d", "carmen", 30)
    scan = log[7]
    ranges_m, angles_rad = driven.ranges_m[7], SICK.angles_rad
    hits = np.isfinite(ranges_m)
    want = ranges_m[hits, None] * np.column_stack([np.cos(angles_rad[hits]), np.sin(angles_rad[hits])])
    assert np.abs(scan.points_body[:, :2] - [SICK.x_m, 0.0] - want).max() < 0.006  # ranges have two decimals
    assert scan.is_planar
    assert not scan.points_body[:, 2].any()
    assert scan.origin_body == pytest.approx([SICK.x_m, 0.0, 0.0], abs=1e-5)
    assert log.wheels.positions_world[:, :2] == pytest.approx(driven.wheels[:, :2], abs=1e-6)
    assert np.array_equal(log.wheels.stamps_ns, log.stamps_ns)


@pytest.mark.parametrize(
    ("beams", "first_deg", "step_deg"),
    [(180, -90.0, 1.0), (181, -90.0, 1.0), (360, -90.0, 0.5), (361, -90.0, 0.5)],
)
def test_number_of_readings_gives_the_directions(tmp_path, beams, first_deg, step_deg):
    x, y, _ = opened(tmp_path / f"beams.{'txt' if beams == 180 else 'clf'}", ["2.00"] * beams)[
        0
    ].points_body.T
    angles_deg = np.degrees(np.arctan2(y, x))
    assert angles_deg == pytest.approx(first_deg + step_deg * np.arange(beams), abs=1e-3)


def test_mounting_is_the_poses_where_no_parameter_states_it(tmp_path, driven):
    path = write_carmen(tmp_path / "run.log", driven)
    path.write_text("\n".join(line for line in path.read_text().splitlines() if not line.startswith("PARAM")))

    log = open_source(path)

    assert log[0].origin_body == pytest.approx([SICK.x_m, 0.0, 0.0], abs=1e-4)


def test_rear_laser_looks_back(tmp_path):
    log = opened(tmp_path / "a.log", ["3.00"] * 181, message="RLASER", poses="-0.2 0 3.14159265 0 0 0")
    scan = log[0]
    assert scan.points_body[:, 0].max() < -0.19
    assert scan.points_body[:, 0].min() == pytest.approx(-3.2, abs=1e-3)


def test_readings_of_the_largest_range_are_no_returns(tmp_path):
    readings = ["1.00"] * 100 + ["81.91"] * 50 + ["nan"] * 20 + ["inf"] * 10
    assert len(opened(tmp_path / "far.log", readings)[0].points_body) == 100


@pytest.mark.parametrize(
    "damaged",
    [
        "FLASER 180 1.0 2.0 3.0",
        "FLASER 999999999 1.0 0 0 0 0 0 0 5.0 host 5.0",
        "FLASER -3 1.0 0 0 0 0 0 0 5.0 host 5.0",
        "FLASER 2 1,5 2,5 0 0 0 0 0 0 5.0 host 5.0",
        "FLASER 2 1.5 2.5 0 0 0 nan 0 0 5.0 host 5.0",
        "FLASER 2 1.5 2.5 0 0 0 0 0 0 never host 5.0",
        "FLASER 3 1.5 2.5 0 0 0 0 0 0 5.0 host",
        "ROBOTLASER1 0 -1.57 3.14 100.0 80 0.01 0 1000 1.0",
        "ROBOTLASER1 0 -1.57",
        "ROBOTLASER1 0 -1.57 3.14 0.0175",
        "FLASER",
    ],
)
def test_damaged_lines_are_left_out_or_refused(tmp_path, driven, damaged):
    path = write_carmen(tmp_path / "run.log", driven)
    path.write_text(path.read_text() + damaged + "\n")
    alone = tmp_path / "alone.log"
    alone.write_text(f"PARAM robot_frontlaser_offset 0.1 nohost 0\n{damaged}\n")

    log = open_source(path)

    assert len(log) == 30
    assert sum("1 lines are damaged" in note for note in log.notes) == 1
    with pytest.raises(SourceError):
        open_source(alone)


def test_other_text_is_no_log_of_it(tmp_path):
    path = tmp_path / "server.log"
    path.write_text("2024-01-01 12:00:00 ODOMETER started\n" * 10)

    with pytest.raises(SourceError):
        open_source(path)


def test_odometry_that_stands_still_is_none(tmp_path):
    log = opened(tmp_path / "hand.log", ["3.00"] * 181)
    assert log.wheels is None
    assert any("stands still" in note for note in log.notes)
