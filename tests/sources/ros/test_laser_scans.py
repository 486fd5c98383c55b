"""sensor_msgs/LaserScan and foxglove.LaserScan in bags, folders and MCAP files."""

from dataclasses import replace

import foxglove
import numpy as np
import pytest
from foxglove.channels import LaserScanChannel
from foxglove.messages import LaserScan, Pose, Quaternion, Timestamp, Vector3

from mapper.core.errors import DataError, SourceError
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.laser_scan import laser_records
from tests.support.planar_drives import RPLIDAR, Drive, drive, flat, write_ros


@pytest.fixture(scope="module")
def driven() -> Drive:
    return drive(flat(), RPLIDAR, speed_mps=0.8).part(20)


@pytest.mark.parametrize(("name", "odometry"), [("run.bag", "topic"), ("run", "topic"), ("run", "tf")])
def test_scans_are_of_the_robot_with_its_wheels(tmp_path, driven, name, odometry):
    log = open_source(write_ros(tmp_path / name, driven, odometry=odometry))

    assert (log.sensor, len(log)) == ("lidar-2d", 20)
    scan = log[5]
    ranges_m, angles_rad = driven.ranges_m[5], RPLIDAR.angles_rad
    hits = np.isfinite(ranges_m)
    want = ranges_m[hits, None] * np.column_stack([np.cos(angles_rad[hits]), np.sin(angles_rad[hits])])
    assert np.abs(scan.points_body[:, :2] - [RPLIDAR.x_m, 0.0] - want).max() < 1e-4
    assert (scan.points_body[:, 2] == np.float32(RPLIDAR.z_m)).all()
    assert scan.is_planar
    assert scan.times_s == pytest.approx(RPLIDAR.beam_s * np.flatnonzero(hits), abs=1e-6)
    assert scan.intensities == pytest.approx(np.full(hits.sum(), 100.0))
    assert log.wheels is not None
    assert log.wheels.positions_world[:, :2] == pytest.approx(driven.readings[:, :2], abs=1e-6)


@pytest.mark.parametrize("odometry", ["topic", "tf"])
def test_wheels_of_a_base_that_nothing_ties_to_the_laser_are_taken_as_its_own(tmp_path, driven, odometry):
    log = open_source(write_ros(tmp_path / "run.bag", driven, odometry=odometry, tied="other"))
    assert log.wheels.positions_world[:, :2] == pytest.approx(driven.readings[:, :2], abs=1e-6)
    assert sum("does not tie base_link to laser" in note for note in log.notes) == 1


def test_turned_laser_sees_the_same(tmp_path, driven):
    straight = open_source(write_ros(tmp_path / "straight", driven))[3]
    turned = open_source(write_ros(tmp_path / "turned", driven, yaw_mount=1.0))[3]

    assert turned.points_body == pytest.approx(straight.points_body, abs=1e-4)


def test_tilted_laser_is_refused(tmp_path, driven):
    path = write_ros(tmp_path / "tilted", driven, pitch_mount=0.3)

    with pytest.raises(SourceError, match="17°"):
        open_source(path)
    assert open_source(path, SourceConfig(body_frame="laser")).sensor == "lidar-2d"


def test_ranges_outside_the_limits_are_no_returns(tmp_path, driven):
    ranges_m = driven.ranges_m.copy()
    ranges_m[:, :50], ranges_m[:, 50:100], ranges_m[:, 100:150] = 0.01, 40.0, np.nan
    ranges_m[:, 150:175], ranges_m[:, 175:200], ranges_m[:, 200:] = -np.inf, RPLIDAR.max_m, 2.0

    log = open_source(write_ros(tmp_path / "limits", replace(driven, ranges_m=ranges_m)))

    assert len(log[0].points_body) == RPLIDAR.beams - 200


def test_foxglove_scans_have_the_same_directions(tmp_path):
    path = tmp_path / "foxglove.mcap"
    with foxglove.open_mcap(path):
        channel = LaserScanChannel("/scan")
        for k in range(1, 6):
            still = Pose(
                position=Vector3(x=0.0, y=0.0, z=0.0), orientation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
            )
            channel.log(
                LaserScan(
                    timestamp=Timestamp(sec=k, nsec=0),
                    frame_id="laser",
                    pose=still,
                    start_angle=-1.0,
                    end_angle=1.0,
                    ranges=[2.0] * 101,
                    intensities=[],
                ),
                log_time=k * 1_000_000_000,
            )

    log = open_source(path)

    x, y, _ = log[0].points_body.T
    assert np.arctan2(y, x) == pytest.approx(np.linspace(-1.0, 1.0, 101), abs=1e-6)
    assert log.sensor == "lidar-2d"


def test_beams_of_one_direction_are_no_scan(driven):
    beams = {"first_rad": -1.0, "intensities": np.zeros(0)}
    with pytest.raises(DataError, match="no laser's directions"):
        laser_records(driven.ranges_m[0], step_rad=0.0, **beams)
    assert len(laser_records(np.array([2.0]), step_rad=0.0, **beams)) == 1


@pytest.mark.parametrize("limit_m", [8.0, np.inf])
def test_ranges_in_other_units_than_their_limit_are_refused(driven, limit_m):
    ranges_m = 1000.0 * driven.ranges_m[0]
    beams = {"first_rad": -1.0, "step_rad": 0.01, "limits_m": (0.0, limit_m), "intensities": np.zeros(0)}
    if np.isfinite(limit_m):
        with pytest.raises(DataError, match="millimetres"):
            laser_records(ranges_m, **beams)
    else:
        assert len(laser_records(ranges_m, **beams)) == np.isfinite(ranges_m).sum()
