"""Sensor model of a spinning LiDAR: rings of ranges with noise, losses, times and its own motion.

The lidar frame has x forward, y left, z up. A sweep begins looking back and turns clockwise seen from
above; its stamp is when it begins, so times are never negative.
"""

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Array
from mapper.simulation.config import LidarSensorConfig
from mapper.simulation.lidar.cast import cast
from mapper.simulation.lidar.scene import OutdoorScene
from mapper.simulation.lidar.traffic import Traffic


def firing_times_s(sensor: LidarSensorConfig) -> Array:
    """Return (A,) seconds after the stamp at which the columns of a sweep are fired."""
    return np.linspace(0.0, sensor.sweep_s, sensor.azimuth_steps, endpoint=False)


def ray_directions(sensor: LidarSensorConfig) -> Array:
    """Return (A, E, 3) unit vectors in the lidar frame: columns in the order of firing, rings from below."""
    steps = np.arange(sensor.azimuth_steps) + 0.5
    azimuth = (np.pi - 2.0 * np.pi * steps / sensor.azimuth_steps)[:, None]
    elevation = np.linspace(sensor.lowest_ring_rad, sensor.highest_ring_rad, sensor.rings)[None, :]
    flat, up = np.cos(elevation), np.broadcast_to(np.sin(elevation), (sensor.azimuth_steps, sensor.rings))
    return np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, up], axis=2)


def column_times_s(sensor: LidarSensorConfig, columns: NDArray[np.intp]) -> NDArray[np.float32]:
    """Return (N,) seconds after the stamp of points of a sweep, given the column of each."""
    return firing_times_s(sensor)[columns].astype(np.float32)


def measure(
    scene: OutdoorScene,
    sensor: LidarSensorConfig,
    T_world_lidar: Array,
    rng: np.random.Generator,
    *,
    traffic: Traffic | None = None,
    start_s: float = 0.0,
) -> tuple[Points32, NDArray[np.intp], NDArray[np.bool_]]:
    """Return the points of a sweep, the column of each, and whether each lies on what moves.

    Args:
        scene: The world, without what moves in it.
        sensor: The LiDAR.
        T_world_lidar: (A, 4, 4) its pose when each column is fired.
        rng: This scan's own noise.
        traffic: Moving objects; None is none.
        start_s: When the sweep begins, seconds after the log does.

    Returns:
        (N, 3) float32 metres in the lidar frame, (N,) columns, (N,) bool.
    """
    rays_lidar = ray_directions(sensor)
    rays_world = np.ascontiguousarray(rays_lidar @ T_world_lidar[:, :3, :3].transpose(0, 2, 1))
    origins_world = np.ascontiguousarray(T_world_lidar[:, :3, 3])
    ranges_m = cast(scene.world, origins_world, rays_world, sensor.max_range_m, True)
    moving = np.zeros(ranges_m.shape, np.bool_)
    if traffic is not None and len(traffic):
        fired_s = firing_times_s(sensor) if sensor.motion_distortion else np.zeros(len(origins_world))
        near_m = traffic.ranges_m(
            origins_world, rays_world, sensor.max_range_m, start_s=start_s, fired_s=fired_s
        )
        moving = near_m < ranges_m
        ranges_m = np.minimum(ranges_m, near_m)
    # Every ray has its own noise, so that what one ray meets does not change another's.
    noise_m = sensor.range_noise_m * rng.standard_normal(ranges_m.shape)
    kept = rng.random(ranges_m.shape) >= sensor.dropout_ratio
    returned = np.isfinite(ranges_m) & (ranges_m >= sensor.min_range_m) & kept
    points = rays_lidar[returned] * (ranges_m + noise_m)[returned, None]
    return points.astype(np.float32), np.nonzero(returned)[0], moving[returned]
