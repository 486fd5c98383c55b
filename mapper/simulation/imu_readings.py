"""Simulated inertial measurement unit of a moving sensor."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S
from mapper.core.units import GRAVITY_MPS2
from mapper.sensing.gyroscope import Gyroscope
from mapper.simulation.config import SynthImuConfig
from mapper.simulation.path import START_NS
from mapper.sources.base import Accelerations

_NAME = "imu.csv"
_STEP_S = 2e-3  # of the differences by which the path's derivatives are taken


def measure_imu(
    config: SynthImuConfig, poses: Callable[[Array], Array], *, duration_s: float, rng: np.random.Generator
) -> tuple[Gyroscope, Accelerations]:
    """Return the angular velocities and accelerations that a unit at the body's origin measures.

    White noise is added to both, and a bias that walks to the angular velocities. The unit is mounted in a
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
    stamps_ns = START_NS + np.round((times_s + config.offset_s) * NS_PER_S).astype(np.int64)
    unit_mps2 = GRAVITY_MPS2 if config.in_g else 1.0
    return Gyroscope(_NAME, stamps_ns, rates_imu), Accelerations(stamps_ns, felt_imu / unit_mps2)
