"""The walls' common direction, along which a map lies straight."""

from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array
from mapper.registration.planes import MIN_AGREEING_RATIO, MIN_PATCHES, PARALLEL_RAD, Patches

_QUARTER_RAD = 0.5 * np.pi
_STEP_RAD = np.radians(0.5)
_ITERATIONS = 5


@dataclass(frozen=True, slots=True)
class WallHeading:
    """The direction of most walls.

    Attributes:
        angle_rad: Angle from the x axis to the nearest of the four directions of the walls, within ±45°,
            counter-clockwise about the vertical.
        agreeing_ratio: Share of the upright patches that face along or across it, to 8°.
        upright: Number of upright patches.
    """

    angle_rad: float
    agreeing_ratio: float
    upright: int

    @property
    def determined(self) -> bool:
        """Whether enough walls agree: not so among trees, or in a round hall."""
        return self.upright >= MIN_PATCHES and self.agreeing_ratio >= MIN_AGREEING_RATIO


def wall_heading(patches: Patches, R_level_world: Array) -> WallHeading:
    """Return the heading that most upright patches face along or across.

    Walls mostly stand at right angles (the "Manhattan world" of Coughlan & Yuille 1999). Every heading of a
    0.5° grid is scored; the best is refined by the mean of those that fit, under Tukey's biweight (Beaton &
    Tukey 1974).

    Args:
        patches: Flat patches of a few scans.
        R_level_world: (3, 3), z up.
    """
    normals = patches.normals_world @ R_level_world.T
    upright = normals[np.abs(normals[:, 2]) < np.sin(PARALLEL_RAD)]
    if not len(upright):
        return WallHeading(0.0, 0.0, 0)
    angles_rad = np.arctan2(upright[:, 1], upright[:, 0])
    grid_rad = np.arange(-0.5 * _QUARTER_RAD, 0.5 * _QUARTER_RAD, _STEP_RAD)
    scores = [_weights(_off_rad(angles_rad, heading_rad)).sum() for heading_rad in grid_rad]
    heading_rad = float(grid_rad[int(np.argmax(scores))])
    for _ in range(_ITERATIONS):
        off_rad = _off_rad(angles_rad, heading_rad)
        weights = _weights(off_rad)
        heading_rad += float(weights @ off_rad / max(float(weights.sum()), 1e-12))
    agreeing = np.abs(_off_rad(angles_rad, heading_rad)) <= PARALLEL_RAD
    return WallHeading(float(_off_rad(heading_rad, 0.0)), float(agreeing.mean()), len(upright))


def _off_rad(angles_rad: Array | float, heading_rad: float) -> Array:
    """Return the angles from the nearest of a heading's four directions, within ±45°."""
    off: Array = np.asarray(angles_rad) - heading_rad
    return off - _QUARTER_RAD * np.round(off / _QUARTER_RAD)


def _weights(off_rad: Array) -> Array:
    weights: Array = np.clip(1.0 - (off_rad / PARALLEL_RAD) ** 2, 0.0, None) ** 2
    return weights
