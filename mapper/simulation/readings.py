"""Readings of a moving sensor's wheels, inertial measurement unit and GNSS receiver, with their errors."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from mapper.core.frames import Sensor
from mapper.core.geodesy import GeodeticOrigin
from mapper.core.geometry import Array, Transform, exp, inverse, transform
from mapper.core.rotations import rotation_from_euler
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.core.units import GRAVITY_MPS2
from mapper.sensing.gnss import GnssFixes
from mapper.sensing.gyroscope import Gyroscope
from mapper.simulation.config import SynthImuConfig, SynthWheelsConfig
from mapper.simulation.gnss_config import SynthGnssConfig
from mapper.simulation.path import START_NS
from mapper.sources.base import Accelerations
from mapper.sources.wheel_files import LOOKING_FORWARD

_IMU_NAME, _GNSS_NAME = "imu.csv", "gnss.txt"
_AXES = np.array([1.0, 1.0, 2.0])
"""Errors of a receiver along east, north and up."""
_STEP_S = 2e-3  # of the differences by which the path's derivatives are taken


def measure_wheels(
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


def measure_imu(
    config: SynthImuConfig, poses: Callable[[Array], Array], *, duration_s: float, rng: np.random.Generator
) -> tuple[Gyroscope, Accelerations]:
    """Return the angular velocities and accelerations that a unit at the body's origin measures.

    White noise is added to both, a bias to the accelerations, and one that walks to the angular velocities.
    The unit is mounted in a
    rotation that the log does not state, and its clock is ahead.

    Args:
        config: Errors, mounting and rate.
        poses: Maps (N,) seconds after the start to (N, 4, 4) exact T_world_body, z up.
        duration_s: Length of the log.
        rng: Source of the errors.
    """
    count = round((duration_s + config.offset_s) * config.rate_hz) + 2
    times_s = np.arange(count) / config.rate_hz
    middle_s = np.maximum(times_s, _STEP_S)
    before, at, after = (poses(middle_s + step_s) for step_s in (-_STEP_S, 0.0, _STEP_S))
    R_before_after = before[:, :3, :3].transpose(0, 2, 1) @ after[:, :3, :3]
    rates_body = Rotation.from_matrix(R_before_after).as_rotvec() / (2.0 * _STEP_S)
    felt_world = (before[:, :3, 3] + after[:, :3, 3] - 2.0 * at[:, :3, 3]) / _STEP_S**2
    felt_world = felt_world + np.array([0.0, 0.0, GRAVITY_MPS2])
    felt_body = np.einsum("nji,nj->ni", at[:, :3, :3], felt_world)
    R_body_imu = Rotation.from_rotvec(config.mounting_rad).as_matrix()
    bias = rng.normal(0.0, config.bias_radps, 3)
    walk = rng.standard_normal((count, 3)) * config.bias_walk_radps_per_sqrt_s / np.sqrt(config.rate_hz)
    noise = config.gyroscope_noise_radps * rng.standard_normal((count, 3))
    rates_imu = rates_body @ R_body_imu + bias + np.cumsum(walk, axis=0) + noise
    felt_imu = felt_body @ R_body_imu + config.accelerometer_noise_mps2 * rng.standard_normal((count, 3))
    felt_imu = felt_imu + rng.normal(0.0, config.accelerometer_bias_mps2, 3)
    stamps_ns = START_NS + np.round((times_s + config.offset_s) * NS_PER_S).astype(np.int64)
    unit_mps2 = GRAVITY_MPS2 if config.in_g else 1.0
    return Gyroscope(_IMU_NAME, stamps_ns, rates_imu), Accelerations(stamps_ns, felt_imu / unit_mps2)


def measure_gnss(
    config: SynthGnssConfig, poses: Callable[[Array], Array], *, duration_s: float, rng: np.random.Generator
) -> GnssFixes:
    """Return the fixes of a receiver whose antenna is on the body; an outage has none.

    Noise is white, a bias is a Gauss-Markov process, and reflections add an offset of one direction. The
    covariance that is stated is that of noise and bias.

    Args:
        config: Errors, antenna, and where the scene is on Earth.
        poses: Maps (N,) seconds after the start to (N, 4, 4) exact T_world_body, z up.
        duration_s: Length of the log.
        rng: Source of the errors.
    """
    count = round(duration_s * config.rate_hz) + 1
    times_s = np.arange(count) / config.rate_hz
    T_world_body = poses(times_s)
    antenna_body = np.array(config.antenna_body)
    antenna_world = T_world_body[:, :3, :3] @ antenna_body + T_world_body[:, :3, 3]
    points_enu = antenna_world @ rotation_from_euler(0.0, 0.0, config.heading_rad).T
    kept_share = np.exp(-1.0 / (config.rate_hz * config.bias_s))
    steps = np.sqrt(1.0 - kept_share**2) * rng.standard_normal((count, 3))
    steps[0] = rng.standard_normal(3)
    bias = lfilter([1.0], [1.0, -kept_share], steps, axis=0)
    errors = config.noise_m * rng.standard_normal((count, 3)) + config.bias_m * bias
    direction = rng.standard_normal(3)
    is_reflected = _during(times_s, config.multipath_start_s, config.multipath_duration_s)
    errors[is_reflected] += config.multipath_m * direction / np.linalg.norm(direction)
    origin = GeodeticOrigin(config.latitude_deg, config.longitude_deg, config.height_m)
    sigmas = np.hypot(config.noise_m, config.bias_m) * _AXES
    fixes = GnssFixes(
        _GNSS_NAME,
        START_NS + np.round(times_s * NS_PER_S).astype(np.int64),
        origin.geodetic(points_enu + _AXES * errors),
        np.tile(np.diag(sigmas**2), (count, 1, 1)),
        np.zeros(count, np.int8),
        antenna_body,
    )
    return fixes.of(~_during(times_s, config.outage_start_s, config.outage_duration_s))


def _during(times_s: Array, start_s: float, duration_s: float) -> NDArray[np.bool_]:
    return np.asarray((times_s >= start_s) & (times_s < start_s + duration_s))
