"""Bundles of a few keyframes by themselves, and parameters of the sensor that are common to them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points
from mapper.odometry.local_map.bundle_adjustment import Observations, adjust, common_parameters

WINDOW_KEYFRAMES = 10
"""Keyframes that are adjusted by themselves: fixed neighbours would bias the parameter to its first value."""
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
        measured: (E, 3) as in ``Observations``.
        weights: (E, 3) as in ``Observations``.
        intrinsics: (5,) as in ``Observations``.
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


Corrected = Callable[[Bundle, Array], tuple[Bundle, Array]]
"""Returns a bundle with measurements or intrinsics that allow for values of N parameters, and the
(N, E, 2 or 3) change of its residuals with each. All are 0 in what the bundle was measured with."""


def estimated(
    bundle: Bundle, corrected: Corrected, *, parameters: int, steps: int, max_step: float
) -> tuple[Array, Array]:
    """Return the (N,) values of parameters of the sensor and their (N, N) information.

    Both are 0 if one of them is not observable.

    They are more unknowns of a bundle adjustment (Triggs et al. 2000, §2.2), whose first keyframe stays where
    it is.

    Args:
        bundle: Keyframes that share their points.
        corrected: How the parameters change the bundle.
        parameters: Their number N.
        steps: Largest number of Gauss–Newton steps, each after an adjustment.
        max_step: Largest change of a parameter at each of them; all steps are scaled by the same factor.
    """
    values, nothing = np.zeros(parameters), np.zeros((parameters, parameters))
    information = nothing
    if not len(bundle.edges):
        return values, nothing
    first_edge = np.searchsorted(bundle.edges[:, 1], np.arange(len(bundle.points) + 1)).astype(np.int32)
    free = np.arange(-1, len(bundle.poses) - 1, dtype=np.int32)
    for _ in range(steps):
        at, slopes = corrected(bundle, values)
        observed = Observations(first_edge, at.edges, at.measured, at.weights, at.intrinsics)
        poses, points, agree = adjust(at.poses, free, at.points, observed, _NO_LINKS, _ROUNDS, _ITERATIONS)
        bundle = replace(bundle, poses=poses, points=points)
        information, gradient = common_parameters(poses, free, points, observed, agree, slopes)
        if np.linalg.eigvalsh(information)[0] <= 0.0:
            return np.zeros(parameters), nothing
        step = -np.linalg.solve(information, gradient)
        step *= min(1.0, max_step / max(np.abs(step).max(), 1e-12))
        values = values + step
        if step @ information @ step < parameters * _CONVERGED_SIGMAS**2:
            break
    return values, information


class WindowEstimates:
    """Estimates of parameters in windows that share no observation, whose spread gives the uncertainty."""

    def __init__(self, *, least: int) -> None:
        """Start without any.

        Args:
            least: With fewer windows there is no estimate.
        """
        self._least = least
        self._values: list[Array] = []
        self._information: list[Array] = []

    @property
    def are_complete(self) -> bool:
        """Whether enough windows were added."""
        return len(self._values) >= _MAX_WINDOWS

    def add(self, values: Array, information: Array) -> None:
        """Add a window's (N,) estimate, unless it has no (N, N) information."""
        if information.any():
            self._values.append(values)
            self._information.append(information)

    def mean(self) -> tuple[Array, Array] | None:
        """Return the (N,) means and their standard deviations; None where windows are too few."""
        if len(self._values) < self._least:
            return None
        values, information = np.array(self._values), np.array(self._information)
        total = information.sum(axis=0)
        mean: Array = np.linalg.solve(total, np.einsum("kij,kj->i", information, values))
        apart = values - mean
        excess = float(np.einsum("ki,kij,kj->", apart, information, apart)) / (values.size - len(mean))
        sigma: Array = np.sqrt(max(excess, 1.0) * np.diag(np.linalg.inv(total)))
        return mean, sigma
