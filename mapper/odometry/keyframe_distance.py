"""Keyframe selection of scan and wheel odometry: by distance and angle from the last keyframe."""

import numpy as np

from mapper.core.geometry import Transform, angle_between
from mapper.odometry.config import GivenOdometryConfig, WheelsOdometryConfig
from mapper.odometry.scans.config import ScanOdometryConfig


def is_far(
    T_keyframe_body: Transform, config: WheelsOdometryConfig | GivenOdometryConfig | ScanOdometryConfig
) -> bool:
    """Return whether the body is so far from the last keyframe, or turned so much, as to need another."""
    return (
        float(np.linalg.norm(T_keyframe_body[:3, 3])) >= config.keyframe_distance_m
        or angle_between(np.eye(3), T_keyframe_body[:3, :3]) >= config.keyframe_angle_rad
    )
