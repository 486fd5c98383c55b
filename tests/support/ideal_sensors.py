"""Sensors without noise: what they measure is the exact truth."""

from mapper.simulation.config import LidarSensorConfig, SensorConfig

IDEAL_SENSOR = SensorConfig(
    axial_noise_ratio=0.0,
    lateral_noise_px=0.0,
    disparity_step_px=0.0,
    dropout_ratio=0.0,
    min_depth_m=0.0,
    fade_depth_m=1e3,
    max_depth_m=1e3,
    image_noise_levels=0.0,
)
"""Exact depth and noise-free images."""

IDEAL_LIDAR = LidarSensorConfig(range_noise_m=0.0, dropout_ratio=0.0, min_range_m=0.0)
"""Exact ranges."""
