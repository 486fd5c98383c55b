"""Keyframe selection of scan and wheel odometry: by distance and angle from the last keyframe."""

from mapper.core.geometry import Transform, length_and_angle
from mapper.odometry.config import GivenOdometryConfig, WheelsOdometryConfig
from mapper.odometry.scans.config import ScanOdometryConfig


def is_far(
    T_keyframe_body: Transform, config: WheelsOdometryConfig | GivenOdometryConfig | ScanOdometryConfig
) -> bool:
    """Return whether the body's distance or turn from the last keyframe asks for another."""
    distance_m, angle_rad = length_and_angle(T_keyframe_body)
    return distance_m >= config.keyframe_distance_m or angle_rad >= config.keyframe_angle_rad
