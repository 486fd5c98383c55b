"""A walk before a desk as frames in memory."""

from functools import cache

import numpy as np

from mapper.core.frames import RgbdFrame
from mapper.simulation.config import SynthConfig
from mapper.simulation.source import CameraSimulator
from mapper.sources.base import Log

DESK_WALK = SynthConfig(
    path="desk", duration_s=3.0, frame_rate_hz=15.0, width_px=320, height_px=240, texture_px_per_m=96
)


@cache
def desk_walk() -> Log:
    """Return the log of the walk, 3 s long."""
    return CameraSimulator(DESK_WALK).log()


@cache
def desk_frames() -> tuple[RgbdFrame, ...]:
    """Return all 46 frames of the walk, without colours."""
    return tuple(entry.load(colour=False) for entry in desk_walk().entries())


def blank(frame: RgbdFrame) -> RgbdFrame:
    """Return the same moment with the lens covered."""
    return RgbdFrame(frame.stamp_ns, np.zeros_like(frame.image), np.zeros_like(frame.depth_m), frame.camera)
