"""Views of a finished run's scans, observed again and deskewed by the gyroscope of the log."""

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mapper.config.loading import load_config
from mapper.core.deskew import twist_at
from mapper.odometry.factory import odometry_for
from mapper.odometry.gyroscope_calibration import GyroscopeCalibration, with_body_rates
from mapper.pipeline.reobserve import reobserve
from mapper.sensing.sweep_motion import motion_during
from mapper.simulation.config import LidarSensorConfig, LidarSynthConfig, SynthImuConfig
from mapper.simulation.lidar.source import LidarSimulator

IMU = SynthImuConfig(bias_radps=0.0)
SWINGING = LidarSynthConfig(
    scene="flat",
    seed=2,
    rate_hz=2.0,
    duration_s=4.0,
    speed_mps=0.2,
    yaw_swing_rad=1.5,
    imu=IMU,
    sensor=LidarSensorConfig(rings=16, azimuth_steps=180, min_range_m=0.3, range_noise_m=0.0),
)


def test_scans_are_deskewed_by_the_gyroscope():
    log = LidarSimulator(SWINGING).log()
    mounting = Rotation.from_rotvec(IMU.mounting_rad).as_matrix()
    calibration = GyroscopeCalibration(mounting, np.zeros(3), IMU.offset_s, 1.0, np.zeros((7, 7)))
    log = with_body_rates(log, calibration)
    config = load_config(sensor="lidar")
    stamp_ns = int(log.stamps_ns[2])
    view = reobserve(log, log.truth, [stamp_ns], config)[stamp_ns]
    observation = odometry_for(config.odometry, log).read(log.entry_at(2))
    by_gyroscope = observation.view(motion_during(observation.scan, log.truth, 2, log.gyroscope))
    by_poses = observation.view(twist_at(log.truth, 2))
    np.testing.assert_array_equal(view.points_body, by_gyroscope.points_body)
    assert len(KDTree(view.points_body).query(by_poses.points_body)[0]) > 100
    assert np.median(KDTree(view.points_body).query(by_poses.points_body)[0]) > 0.01
