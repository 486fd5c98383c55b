"""Bundles of a few keyframes by themselves, and parameters of the sensor that are common to them."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points
from mapper.odometry.local_map.bundle_adjustment import adjust, common_parameter

WINDOW_KEYFRAMES = 10
"""Keyframes that are adjusted by themselves: neighbours outside would hold them to the parameter given."""
_ROUNDS, _ITERATIONS = 2, 10
_MAX_WINDOWS = 16
_CONVERGED_SIGMAS = 0.05
_NO_LINKS = np.empty((0, 2), np.int32), np.empty((0, 4, 4)), np.empty((0, 6, 6))


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """Some keyframes, the landmarks that they share, and their observations.

    Attributes:
        poses: (K, 4, 4) T_camera_world.
        points: (P, 3) metres, world.
        edges: (E, 2) int32 keyframe and point of each observation, grouped by point.
        features: (E,) feature of each observation among those of its keyframe.
        measured: (E, 3) as for ``adjust``.
        weights: (E, 3) as for ``adjust``.
        intrinsics: (5,) as for ``adjust``.
    """

    poses: Array
    points: Points
    edges: NDArray[np.int32]
    features: NDArray[np.integer]
    measured: Array
    weights: Array
    intrinsics: Array

    def of_points_seen_by(self, keyframes: int) -> "Bundle":
        """Return the bundle without the points that fewer keyframes observe."""
        observers = np.bincount(self.edges[:, 1], minlength=len(self.points))
        kept = (observers >= keyframes)[self.edges[:, 1]]
        points, rows = np.unique(self.edges[kept, 1], return_inverse=True)
        return replace(
            self,
            points=self.points[points],
            edges=np.column_stack([self.edges[kept, 0], rows]).astype(np.int32),
            features=self.features[kept],
            measured=self.measured[kept],
            weights=self.weights[kept],
        )

    def points_camera(self) -> Points:
        """Return the (E, 3) observed points in the axes of their cameras, at least 1 mm ahead."""
        T = self.poses[self.edges[:, 0]]
        points: Points = np.einsum("nij,nj->ni", T[:, :3, :3], self.points[self.edges[:, 1]]) + T[:, :3, 3]
        points[:, 2] = np.maximum(points[:, 2], 1e-3)
        return points


Corrected = Callable[[Bundle, float], tuple[Bundle, Array]]
"""Returns a bundle with measurements or intrinsics that allow for a value of a parameter, and the (E, 2 or 3)
change of its residuals with the parameter. The value 0 is what the bundle was measured with."""


def estimated(bundle: Bundle, corrected: Corrected, *, steps: int, max_step: float) -> tuple[float, float]:
    """Return the value of a parameter of the sensor and its information; both 0 if nothing tells it.

    It is one more unknown of a bundle adjustment (Triggs et al. 2000, §2.2), whose first keyframe stays where
    it is.

    Args:
        bundle: Keyframes that share their points.
        corrected: How the parameter changes the bundle.
        steps: Largest number of Gauss–Newton steps, each after an adjustment.
        max_step: Largest change of the parameter at each of them.
    """
    value = information = 0.0
    if not len(bundle.edges):
        return value, information
    first_edge = np.searchsorted(bundle.edges[:, 1], np.arange(len(bundle.points) + 1)).astype(np.int32)
    free = np.arange(-1, len(bundle.poses) - 1, dtype=np.int32)
    for _ in range(steps):
        at, slopes = corrected(bundle, value)
        observed = first_edge, at.edges, at.measured, at.weights, at.intrinsics
        poses, points, agree = adjust(at.poses, free, at.points, *observed, _NO_LINKS, _ROUNDS, _ITERATIONS)
        bundle = replace(bundle, poses=poses, points=points)
        information, gradient = common_parameter(poses, free, points, *observed, agree, slopes)
        if information <= 0.0:
            return 0.0, 0.0
        step = float(np.clip(-gradient / information, -max_step, max_step))
        value += step
        if abs(step) * math.sqrt(information) < _CONVERGED_SIGMAS:
            break
    return value, information


class WindowEstimates:
    """Estimates of a parameter in windows that share no observation; their spread tells how certain it is."""

    def __init__(self, *, least: int) -> None:
        """Start without any.

        Args:
            least: Fewer windows tell nothing.
        """
        self._least = least
        self._values: list[float] = []
        self._information: list[float] = []

    @property
    def are_complete(self) -> bool:
        """Whether enough windows were added."""
        return len(self._values) >= _MAX_WINDOWS

    def add(self, value: float, information: float) -> None:
        """Add a window's estimate, unless it has no information."""
        if information > 0.0:
            self._values.append(value)
            self._information.append(information)

    def mean(self) -> tuple[float, float]:
        """Return the mean and its standard deviation; 0 and infinity where windows are too few."""
        if len(self._values) < self._least:
            return 0.0, math.inf
        values, information = np.array(self._values), np.array(self._information)
        mean = float(np.average(values, weights=information))
        excess = float((information * (values - mean) ** 2).sum()) / (len(values) - 1)
        return mean, math.sqrt(max(excess, 1.0) / information.sum())
