"""Independent random streams of one seed, so that no part of a log depends on the order of the others."""

from enum import IntEnum

import numpy as np

TRIES = 40
"""Random places that are tried for a thing before it is left out."""


class Stream(IntEnum):
    """Purpose of a stream; a seed's results depend on these numbers."""

    PLAN = 0
    SURFACES = 1
    FURNITURE = 2
    PATH = 3
    SENSOR = 4
    DROPS = 5
    MOVERS = 6
    GROUND = 7
    WHEELS = 8
    PEOPLE = 9
    HAND = 10
    GAINS = 11
    WARP = 12
    DAY = 13
    IMU = 14
    GNSS = 15


def rng_of(seed: int, stream: Stream, index: int = 0) -> np.random.Generator:
    """Return the generator of a stream's index-th part, e.g. of one frame's noise."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(stream), index)))


def noise_index(day: int, frame: int) -> int:
    """Return which part of the sensor's stream a frame has: another day's noise is another."""
    return (day << 32) + frame
