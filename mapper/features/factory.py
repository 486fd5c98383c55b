"""Detector factory."""

from typing import assert_never

from mapper.features.base import Detector
from mapper.features.config import (
    AkazeConfig,
    DetectorConfig,
    OrbConfig,
    SiftConfig,
    SurfConfig,
    UniformOrbConfig,
)


def build_detector(config: DetectorConfig) -> Detector:
    """Return the detector that the settings choose; its module is imported only now."""
    match config:
        case SurfConfig():
            from mapper.features.surf import Surf

            return Surf(config)
        case SiftConfig():
            from mapper.features.opencv import Sift

            return Sift(config)
        case AkazeConfig():
            from mapper.features.opencv import Akaze

            return Akaze(config)
        case OrbConfig():
            from mapper.features.opencv import Orb

            return Orb(config)
        case UniformOrbConfig():
            from mapper.features.uniform_orb import UniformOrb

            return UniformOrb(config)
        case _:
            assert_never(config)
