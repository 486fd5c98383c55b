"""Ground that slopes and gently undulates: a plane plus a few long waves, exact everywhere."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from mapper.core.geometry import Array

Vector = tuple[float, float, float]

_WAVES = 3
_SHORTEST_WAVE_M, _LONGEST_WAVE_M = 25.0, 70.0
_TOUCH_M = 1e-6
_STEPS = 100


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """z = slope · (x, y) + Σ amplitude · sin(wave · (x, y) + phase).

    Attributes:
        slope: (2,) rise per metre along x and y.
        waves: (K, 4) amplitude in metres, wave vector x and y in radians per metre, phase in radians.
    """

    slope: Array
    waves: Array

    def height_m(self, points_xy: Array) -> Array:
        """Return (N,) heights above z = 0 at (N, 2) places."""
        return points_xy @ self.slope + np.sin(self._angles(points_xy)) @ self.waves[:, 0]

    def normals(self, points_xy: Array) -> Array:
        """Return (N, 3) unit normals, upwards, at (N, 2) places."""
        swing = np.cos(self._angles(points_xy)) * self.waves[:, 0]
        rise = self.slope + swing @ self.waves[:, 1:3]
        normals = np.column_stack([-rise, np.ones(len(rise))])
        unit: Array = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        return unit

    def as_json(self) -> dict[str, list[Any]]:
        """Return both attributes, with every digit."""
        return {"slope": self.slope.tolist(), "waves": self.waves.tolist()}

    def _angles(self, points_xy: Array) -> Array:
        return points_xy @ self.waves[:, 1:3].T + self.waves[:, 3]


def make_ground(rng: np.random.Generator, *, slope_rad: float, undulation_m: float) -> Ground:
    """Return ground that rises by an angle in any direction and swings by at most ``undulation_m``."""
    uphill_rad = rng.uniform(0.0, 2.0 * np.pi)
    amplitudes_m = undulation_m * rng.dirichlet(np.ones(_WAVES))
    directions_rad, phases_rad = rng.uniform(0.0, 2.0 * np.pi, (2, _WAVES))
    rates = 2.0 * np.pi / rng.uniform(_SHORTEST_WAVE_M, _LONGEST_WAVE_M, _WAVES)
    return Ground(
        slope=math.tan(slope_rad) * np.array([np.cos(uphill_rad), np.sin(uphill_rad)]),
        waves=np.column_stack(
            [amplitudes_m, rates * np.cos(directions_rad), rates * np.sin(directions_rad), phases_rad]
        ),
    )


@njit(cache=True, nogil=True)
def ground_range_m(slope: Array, waves: Array, origin: Vector, direction: Vector, limit_m: float) -> float:
    """Return how far along a ray the ground is, metres; inf where it is not within the limit.

    No step is longer than where the ray could be at the soonest if the ground rose towards it as fast as
    the waves' curvature lets it: the root of gap + rate·s − bend·s²/2. So none passes through, as in sphere
    tracing (Hart 1996), and the last steps converge like Newton's.
    """
    dx, dy, dz = direction
    bend = 1e-12
    for k in range(len(waves)):
        bend += abs(waves[k, 0]) * (waves[k, 1] * dx + waves[k, 2] * dy) ** 2
    t = 0.0
    for _ in range(_STEPS):
        x, y = origin[0] + t * dx, origin[1] + t * dy
        gap = origin[2] + t * dz - slope[0] * x - slope[1] * y
        rate = dz - slope[0] * dx - slope[1] * dy
        for k in range(len(waves)):
            angle = waves[k, 1] * x + waves[k, 2] * y + waves[k, 3]
            gap -= waves[k, 0] * math.sin(angle)
            rate -= waves[k, 0] * math.cos(angle) * (waves[k, 1] * dx + waves[k, 2] * dy)
        if gap < _TOUCH_M:
            return t
        root = math.sqrt(rate * rate + 2.0 * bend * gap)
        t += (rate + root) / bend if rate > 0.0 else 2.0 * gap / (root - rate)
        if t > limit_m:
            return np.inf
    return np.inf
