"""Settings of `mapper compare`."""

import math
from typing import Annotated

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from mapper.core.config import Config
from mapper.core.frames import Sensor
from mapper.sources.config import SourceConfig


class GuessConfig(Config):
    """Kind of guess: how far from the truth a registration begins, at most."""

    offset_m: NonNegativeFloat
    turn_rad: Annotated[float, Field(ge=0.0, le=math.pi)]

    @property
    def text(self) -> str:
        """The two limits, e.g. "0.2 m, 10°"."""
        return f"{self.offset_m:g} m, {math.degrees(self.turn_rad):.3g}°"


FramesApart = Annotated[tuple[PositiveInt, ...], Field(min_length=1)]
Guesses = Annotated[tuple[GuessConfig, ...], Field(min_length=1)]


class TrialsConfig(Config):
    """Settings of trials: pairs of frames, kinds of guesses, and what counts as right."""

    frames_apart: FramesApart
    """Each distance gets as many pairs as the others."""
    guesses: Guesses
    max_error_m: PositiveFloat
    max_error_rad: PositiveFloat
    """A registration farther off than either is wrong."""


class RgbdCompareConfig(TrialsConfig):
    """Settings for RGB-D logs, whose scenes are a few metres wide."""

    max_depth_m: PositiveFloat = 4.0
    """Deeper measurements are left out of a scan."""
    stride_px: PositiveInt = 2
    """Every n-th row and column of the depth image becomes a point of the scan."""
    frames_apart: FramesApart = (1, 5, 15)
    guesses: Guesses = (
        GuessConfig(offset_m=0.05, turn_rad=math.radians(3.0)),
        GuessConfig(offset_m=0.2, turn_rad=math.radians(10.0)),
        GuessConfig(offset_m=0.5, turn_rad=math.radians(20.0)),
    )
    max_error_m: PositiveFloat = 0.05
    max_error_rad: PositiveFloat = math.radians(2.0)


class LidarCompareConfig(TrialsConfig):
    """Settings for LiDAR logs, whose scenes are a street wide; guesses are off in the plane only."""

    frames_apart: FramesApart = (1, 5, 10)
    guesses: Guesses = (
        GuessConfig(offset_m=0.5, turn_rad=math.radians(5.0)),
        GuessConfig(offset_m=2.0, turn_rad=math.radians(20.0)),
        GuessConfig(offset_m=10.0, turn_rad=math.radians(180.0)),
    )
    max_error_m: PositiveFloat = 0.3
    max_error_rad: PositiveFloat = math.radians(1.0)


class CompareConfig(Config):
    """All settings of ``mapper compare``."""

    source: SourceConfig = SourceConfig()
    methods: tuple[str, ...] = ()
    """Names of the methods to compare; empty is all that can use the log."""
    pairs: NonNegativeInt = 30
    """Pairs of frames to register, spread evenly over the log."""
    seed: NonNegativeInt = 0
    """Seed of the guesses' errors."""
    rgbd: RgbdCompareConfig = RgbdCompareConfig()
    lidar: LidarCompareConfig = LidarCompareConfig()

    def trials(self, sensor: Sensor) -> TrialsConfig:
        """Return which registrations are tried on logs of a sensor."""
        return self.rgbd if sensor == "rgbd" else self.lidar
