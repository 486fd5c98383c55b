"""Keyframes of a scanner in synthetic streets, at any pose on them."""

from functools import cache

import numpy as np

from mapper.core.frames import Points32
from mapper.core.geometry import Transform, rotation_exp, transform
from mapper.features.frame_view import ScanView
from mapper.simulation.config import STREET, LidarSensorConfig
from mapper.simulation.lidar import OutdoorScene, make_outdoor_scene
from mapper.simulation.lidar.source import measure

MOUNT_M = 1.7
SENSOR = LidarSensorConfig(rings=32, azimuth_steps=360)


@cache
def street(seed: int, *, loop_m: float = 150.0, day: int = 0) -> OutdoorScene:
    """Return a block of streets."""
    return make_outdoor_scene(STREET.model_copy(update={"seed": seed, "loop_m": loop_m, "day": day}))


def on_street(scene: OutdoorScene, along_m: float, *, yaw_rad: float = 0.0, left_m: float = 0.0) -> Transform:
    """Return the (4, 4) pose of a scanner on a street, turned from where the street leads."""
    heading = float(scene.route.headings_rad(np.array([along_m]))[0])
    place = scene.route.points(np.array([along_m])) + left_m * np.array([[-np.sin(heading), np.cos(heading)]])
    height_m = float(scene.ground.height_m(place)[0]) + MOUNT_M
    R = rotation_exp(np.array([0.0, 0.0, heading + yaw_rad]))
    return transform(R, np.array([*place[0], height_m]))


def still_scan(
    scene: OutdoorScene, sensor: LidarSensorConfig, T_world_lidar: Transform, *, seed: int = 0
) -> Points32:
    """Return the (N, 3) points, sensor frame, that a sensor measures which stands still."""
    poses = np.broadcast_to(T_world_lidar, (sensor.azimuth_steps, 4, 4))
    return measure(scene, sensor, poses, np.random.default_rng(seed))[0]


def view(scene: OutdoorScene, T_world_body: Transform, *, stamp_ns: int = 0, seed: int = 0) -> ScanView:
    """Return what the scanner sees from there, with its own noise."""
    return ScanView(stamp_ns, still_scan(scene, SENSOR, T_world_body, seed=seed))
