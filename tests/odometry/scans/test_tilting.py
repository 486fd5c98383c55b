"""Scans of a sensor that tilts, so that it soon sees another part of the scene than its keyframe."""

import numpy as np

from mapper.core.geometry import inverse
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.scans.config import GicpOdometryConfig
from mapper.simulation.config import STREET, LidarSensorConfig
from mapper.simulation.lidar import LidarSimulator


def test_a_rolling_sensor_is_followed():
    settings = {"seed": 82, "duration_s": 2.0, "tilt_rad": 0.52, "sensor": LidarSensorConfig(rings=32)}
    log = LidarSimulator(STREET.model_copy(update=settings)).log()
    odometry = build_frame_odometry(GicpOdometryConfig())

    results = [odometry.track(odometry.observe(entry.load())) for entry in log.entries()]

    assert all(result.node is not None for result in results)
    assert not any(result.doubts for result in results)
    assert [result.stamp_ns for result in results] == log.truth.stamps_ns.tolist()
    for result, T_world_body in zip(results, log.truth.T_world_body, strict=True):
        error = inverse(inverse(log.truth.T_world_body[0]) @ T_world_body) @ result.T_world_body
        assert np.linalg.norm(error[:3, 3]) < 0.12
