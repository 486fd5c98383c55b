"""Hand-held scans at 2 Hz in fast turns, tracked with the gyroscope of the log."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mapper.core.geometry import fit_rigid
from mapper.odometry.factory import odometry_for
from mapper.odometry.scans.config import GicpOdometryConfig
from mapper.simulation.config import LidarSensorConfig, LidarSynthConfig, SynthImuConfig
from mapper.simulation.lidar.source import LidarSimulator

IMU = SynthImuConfig()
SWINGING = LidarSynthConfig(
    scene="courtyard",
    seed=2,
    loop_m=60.0,
    rate_hz=2.0,
    duration_s=12.0,
    speed_mps=1.2,
    tilt_rad=0.3,
    yaw_swing_rad=1.5,
    imu=IMU,
    sensor=LidarSensorConfig(rings=16, lowest_ring_rad=-0.26, highest_ring_rad=0.26, azimuth_steps=450),
)


def test_a_gyroscope_whose_mounting_is_stated_keeps_the_path():
    log = LidarSimulator(SWINGING).log()
    R_body_imu = Rotation.from_rotvec(IMU.mounting_rad).as_matrix()
    log = replace(log, gyroscope=replace(log.gyroscope, R_body_imu=R_body_imu))
    odometry = odometry_for(GicpOdometryConfig(), log)
    results = [odometry.track(odometry.read(entry)) for entry in log.entries()]
    positions = np.array([result.T_world_body[:3, 3] for result in results])
    true = log.truth.positions_world
    T, _ = fit_rigid(true, positions)
    errors_m = np.linalg.norm(positions @ T[:3, :3].T + T[:3, 3] - true, axis=1)
    assert np.sqrt((errors_m**2).mean()) < 0.03
    assert not any(result.doubts for result in results)
    assert any("offset 7 ±" in note for note in odometry.gyroscope_notes())
