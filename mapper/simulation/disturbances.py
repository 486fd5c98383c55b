"""Disturbances of a recording: gaps, a frozen camera, a hand before the lens, jumps of the exposure."""

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Image
from mapper.core.geometry import Array
from mapper.simulation.config import DisturbanceConfig, SynthConfig
from mapper.simulation.noise import fractal, tinted
from mapper.simulation.raycast import Rendering
from mapper.simulation.streams import Stream, rng_of

_SKIN = (196, 148, 122)
_SWAY_SHARE, _SWAY_HZ = 0.03, 0.4
_HAND_BULGE = 0.15


def between(times_s: Array, start_s: float, duration_s: float) -> NDArray[np.bool_]:
    """Return which of (N,) times lie in an interval, its end excluded."""
    return (times_s >= start_s) & (times_s < start_s + duration_s)


def shown_frames(config: DisturbanceConfig, times_s: Array) -> NDArray[np.intp]:
    """Return (N,) which frame's image is recorded for each: its own, or the one at which the camera froze."""
    shown = np.arange(len(times_s))
    frozen = np.flatnonzero(between(times_s, config.freeze_start_s, config.freeze_duration_s))
    shown[frozen] = max(frozen[0] - 1, 0) if len(frozen) else 0
    return shown


def disturbed(rendering: Rendering, config: SynthConfig, time_s: float) -> Rendering:
    """Return an exact image with the hand and the exposure that it has at a time, seconds after the start."""
    disturbances = config.disturbances
    if between(np.array(time_s), disturbances.hand_start_s, disturbances.hand_duration_s):
        rendering = _behind_hand(rendering, config, time_s)
    if disturbances.gain_step_s > 0.0:
        gain = gain_at(disturbances, time_s, seed=config.seed)
        rgb: Image = np.clip(np.rint(gain * rendering.rgb.astype(np.float32)), 0, 255).astype(np.uint8)
        rendering = replace(rendering, rgb=rgb)
    return rendering


def gain_at(config: DisturbanceConfig, time_s: float, *, seed: int) -> float:
    """Return by what the image's brightness is multiplied: by 1 at first, then more and less in turns."""
    step = int(time_s / config.gain_step_s)
    if step == 0:
        return 1.0
    share = float(rng_of(seed, Stream.GAINS, step).uniform(0.5, 1.0))
    return math.exp((share if step % 2 else -share) * math.log(config.gain_factor))


def _behind_hand(rendering: Rendering, config: SynthConfig, time_s: float) -> Rendering:
    """Return the image with an ellipse of skin in its middle, which sways a little."""
    height, width = rendering.depth_m.shape
    reach = math.sqrt(config.disturbances.hand_share / math.pi)
    angle = 2.0 * math.pi * _SWAY_HZ * time_s
    column = (np.arange(width) + 0.5) / width - 0.5 - _SWAY_SHARE * math.sin(angle)
    row = (np.arange(height)[:, None] + 0.5) / height - 0.5 - _SWAY_SHARE * math.sin(0.7 * angle)
    square = ((column / reach) ** 2 + (row / reach) ** 2).astype(np.float32)
    is_hand = square < 1.0
    rng = rng_of(config.seed, Stream.HAND)
    skin = tinted(_SKIN, 0.08 * fractal(rng, (height, width), cell_px=(height / 4, width / 4)))
    shift = np.array([[1, 0, _SWAY_SHARE * width * math.sin(angle)], [0, 1, 0]], dtype=np.float32)
    skin = np.asarray(cv2.warpAffine(skin, shift, (width, height), borderMode=cv2.BORDER_REFLECT), np.uint8)
    depth_m = np.float32(config.disturbances.hand_distance_m) * (1 + np.float32(_HAND_BULGE) * square)
    return Rendering(
        np.where(is_hand[:, :, None], skin, rendering.rgb),
        np.where(is_hand, depth_m, rendering.depth_m),
        np.where(is_hand, np.int32(-1), rendering.surface),
        np.where(is_hand, np.float32(1.0), rendering.cosine),
    )
