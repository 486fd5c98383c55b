"""Sweeps of a hand-held LiDAR, deskewed at their final poses by the calibrated gyroscope of the log."""

import numpy as np

from mapper.core.deskew import Twist
from mapper.core.geometry import inverse, rotation_log
from mapper.core.timebase import NS_PER_S
from mapper.odometry.gyroscope_calibration import calibrate, with_body_rates
from mapper.run.manifest_logs import GyroscopeFit
from mapper.sensing.sweep_motion import motion_during
from mapper.simulation.config import LidarSensorConfig, LidarSynthConfig, SynthImuConfig
from mapper.simulation.lidar.source import LidarSimulator

SWINGING = LidarSynthConfig(
    scene="courtyard",
    seed=2,
    loop_m=60.0,
    rate_hz=2.0,
    duration_s=10.0,
    tilt_rad=0.3,
    yaw_swing_rad=1.5,
    imu=SynthImuConfig(),
    sensor=LidarSensorConfig(rings=4, azimuth_steps=90),
)


def calibrated_log(simulator):
    log = simulator.log()
    stamps_ns, R = log.truth.stamps_ns, log.truth.T_world_body[:, :3, :3]
    found = calibrate(log.gyroscope, stamps_ns[:-1], stamps_ns[1:], R[:-1].transpose(0, 2, 1) @ R[1:])
    return log, found


def turn_errors_rad(simulator, log, gyroscope):
    """Errors of the rotation at the end of each sweep, but for those at the ends of the log."""
    errors = []
    for index in range(1, len(log) - 1):
        scan = simulator.observe(index)
        end_s = float(scan.times_s.max())
        start_s = (scan.stamp_ns - log.truth.stamps_ns[0]) / NS_PER_S
        begin, end = simulator.drive.poses(np.array([start_s, start_s + end_s]))
        found = motion_during(scan, log.truth, index, gyroscope).over(end_s)
        errors.append(np.linalg.norm(rotation_log((inverse(found) @ inverse(begin) @ end)[:3, :3])))
    return np.array(errors)


def test_the_gyroscope_knows_the_turn_during_a_sweep_that_poses_half_a_second_apart_do_not():
    simulator = LidarSimulator(SWINGING)
    log, found = calibrated_log(simulator)
    by_gyroscope = turn_errors_rad(simulator, log, with_body_rates(log, found).gyroscope)
    by_poses = turn_errors_rad(simulator, log, None)
    assert by_gyroscope.max() < 0.004
    assert np.median(by_poses) > 5.0 * by_gyroscope.max()


def test_readings_that_are_not_calibrated_do_not_count():
    simulator = LidarSimulator(SWINGING)
    log, _ = calibrated_log(simulator)
    assert isinstance(motion_during(simulator.observe(3), log.truth, 3, log.gyroscope), Twist)


def test_a_manifest_keeps_the_calibration_to_the_bit():
    _, found = calibrated_log(LidarSimulator(SWINGING))
    kept = GyroscopeFit.model_validate_json(GyroscopeFit.of(found).model_dump_json()).calibration
    np.testing.assert_array_equal(kept.R_body_imu, found.R_body_imu)
    np.testing.assert_array_equal(kept.bias, found.bias)
    assert (kept.offset_s, kept.scale) == (found.offset_s, found.scale)


def test_a_log_is_calibrated_once():
    log, found = calibrated_log(LidarSimulator(SWINGING))
    calibrated = with_body_rates(log, found)
    assert with_body_rates(calibrated, found) is calibrated
    assert with_body_rates(log, None) is log
