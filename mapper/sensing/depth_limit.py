"""Limit of depth returns by their noise: near ones are obstacles, far ones only tell that space is free."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from mapper.core.frames import Points32, Scan
from mapper.sensing.config import DepthNoiseConfig

_FARTHEST_M = 100.0
_FREE_SIGMAS = 2.0
"""A noisy return frees space up to so many standard deviations before it."""


@dataclass(frozen=True, slots=True)
class DepthLimit:
    """Which returns of a depth camera count.

    Attributes:
        noise: Standard deviation σ(z) of the camera's depth.
        max_sigma_m: The largest with which a return counts as an obstacle.
    """

    noise: DepthNoiseConfig
    max_sigma_m: float

    @property
    def depth_m(self) -> float:
        """Least depth at which σ exceeds the limit, at most 100 m, which no depth camera reaches."""
        a, b, c = self.noise.constant_m - self.max_sigma_m, self.noise.linear, self.noise.quadratic_per_m
        if a >= 0.0:
            return 0.0
        if c == 0.0:
            return min(-a / b, _FARTHEST_M) if b > 0.0 else _FARTHEST_M
        return min((-b + math.sqrt(b * b - 4.0 * a * c)) / (2.0 * c), _FARTHEST_M)

    def split(self, scan: Scan) -> tuple[Scan, Points32]:
        """Return the scan with the returns that count alone, and (M, 3) ends of rays that only free space.

        The ray of any other return frees space up to 2 σ before it, but not beyond ``depth_m``.

        Args:
            scan: Returns of a depth camera; z of the body is its optical axis.
        """
        limit_m = self.depth_m
        z = scan.points_body[:, 2] - np.float32(scan.origin_body[2])
        if not len(z) or z.max() <= limit_m:
            return scan, np.empty((0, 3), np.float32)
        near = z <= limit_m
        noise = self.noise.constant_m, self.noise.linear, self.noise.quadratic_per_m
        free_ends = _free_ends(scan.points_body, scan.origin_body, noise, limit_m)
        colors = None if scan.colors is None else scan.colors[near]
        return Scan(scan.stamp_ns, scan.points_body[near], scan.origin_body, colors), free_ends


@njit(cache=True, nogil=True)
def _free_ends(points, origin, noise, limit_m):  # type: ignore[no-untyped-def]
    """Return where the rays of returns beyond a depth stop to free space; some free none."""
    a, b, c = noise
    ends = np.empty((len(points), 3), np.float32)
    count = 0
    for i in range(len(points)):
        z = np.float64(points[i, 2]) - origin[2]
        if z <= limit_m:
            continue
        stop_m = min(z - _FREE_SIGMAS * (a + z * (b + z * c)), limit_m)
        if stop_m > 0.0:
            for axis in range(3):
                ends[count, axis] = origin[axis] + (points[i, axis] - origin[axis]) * (stop_m / z)
            count += 1
    return ends[:count].copy()
