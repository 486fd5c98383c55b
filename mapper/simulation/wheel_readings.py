"""Simulated wheel odometry of a vehicle that carries a sensor."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from mapper.core.frames import Sensor
from mapper.core.geometry import Array, Transform, exp, inverse, transform
from mapper.core.rotations import rotation_from_euler
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.simulation.config import SynthWheelsConfig
from mapper.simulation.path import START_NS
from mapper.sources.wheel_files import LOOKING_FORWARD


def counted(
    config: SynthWheelsConfig,
    poses: Callable[[Array], Array],
    *,
    duration_s: float,
    sensor: Sensor,
    rng: np.random.Generator,
) -> Trajectory:
    """Return T_odom_body of wheel odometry with errors, for a vehicle on what it takes for level ground.

    An error of the wheels' size scales every path, an error of their distance scales every turn, and uneven
    ground adds a random walk of the heading. Wheels measure no height and no tilt: the body keeps the
    mounting that it has at first.

    Args:
        config: Size of the errors, and rate of the readings.
        poses: Maps (N,) seconds after the start to (N, 4, 4) exact T_world_body.
        duration_s: Length of the log.
        sensor: Sensor whose frame is the body's.
        rng: Source of the errors.
    """
    count = round(duration_s * config.rate_hz) + 2  # the last reading is after the last frame
    since_start_ns = np.round(np.arange(count) * (NS_PER_S / config.rate_hz)).astype(np.int64)
    T_world_body = poses(since_start_ns / NS_PER_S)
    T_world_base = [_upright(T, sensor) for T in T_world_body]
    longer, rounder = rng.normal(0.0, [config.path_sigma, config.turn_sigma])
    T_odom_base = [np.eye(4)]
    for before, after in pairwise(T_world_base):
        step = inverse(before) @ after
        path_m = float(np.linalg.norm(step[:2, 3]))
        turn_rad = float(np.arctan2(step[1, 0], step[0, 0])) * (1.0 + rounder)
        turn_rad += config.heading_rad_per_sqrt_m * float(np.sqrt(path_m) * rng.standard_normal())
        measured = exp(np.array([0.0, 0.0, turn_rad]), np.zeros(3))
        measured[:3, 3] = step[:3, 3] * (1.0 + longer)
        T_odom_base.append(T_odom_base[-1] @ measured)
    T_base_body = inverse(T_world_base[0]) @ T_world_body[0]
    return Trajectory(START_NS + since_start_ns, np.array(T_odom_base) @ T_base_body)


def _upright(T_world_body: Transform, sensor: Sensor) -> Transform:
    """Return the pose of an upright base on the floor below a body, x along the body's forward axis."""
    ahead = (T_world_body @ inverse(LOOKING_FORWARD[sensor]))[:2, 0]
    yaw_rad = float(np.arctan2(ahead[1], ahead[0]))
    return transform(rotation_from_euler(0.0, 0.0, yaw_rad), np.array([*T_world_body[:2, 3], 0.0]))
