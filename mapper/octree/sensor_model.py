"""OctoMap's sensor model in log-odds (Hornung et al. 2013, eq. 2 to 4)."""

from typing import NamedTuple

import numpy as np

from mapper.octree.config import OctreeConfig


class SensorModel(NamedTuple):
    """Float32 log-odds: the increments of a hit and a miss, and the clamping limits."""

    hit: np.float32
    miss: np.float32
    lowest: np.float32
    highest: np.float32


def sensor_model(config: OctreeConfig) -> SensorModel:
    """Return the sensor model of a map's settings."""
    return SensorModel(
        hit=log_odds(config.hit_probability),
        miss=log_odds(config.miss_probability),
        lowest=log_odds(config.clamp_min_probability),
        highest=log_odds(config.clamp_max_probability),
    )


def log_odds(probability: float) -> np.float32:
    """Return ln(p / (1 − p)) rounded to float32, as OctoMap stores it."""
    return np.float32(np.log(probability / (1.0 - probability)))
