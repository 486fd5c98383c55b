"""Bundles of a few keyframes by themselves, and parameters of the sensor that are common to them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points
from mapper.odometry.local_map.bundle.bundle_adjustment import Observations, adjust, common_parameters

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
    bundle: Bundle, corrected: Corrected, *, prior_sigmas: Array, max_steps: Array, sigmas: Sequence[float]
) -> tuple[Array, Array]:
    """Return the (N,) values of parameters of the sensor and their (N, N) information without the prior.

    Both are 0 if the bundle tells nothing.

    They are more unknowns of a bundle adjustment (Triggs et al. 2000, §2.2), whose first keyframe stays where
    it is.

    Args:
        bundle: Keyframes that share their points.
        corrected: How the parameters, and perhaps more, change the bundle.
        prior_sigmas: (N,) standard deviations of the values before; they keep what is not observable near 0.
        max_steps: (N,) largest changes of the parameters at a step, which is scaled as a whole.
        sigmas: Factor on all standard deviations at each Gauss–Newton step, which follows an adjustment: with
            larger ones at first, what the parameters displace is no outlier (graduated non-convexity, Yang et
            al. 2020). Where it is 1 it may be the last step.
    """
    parameters = len(prior_sigmas)
    values, nothing = np.zeros(parameters), np.zeros((parameters, parameters))
    prior, information = np.diag(prior_sigmas**-2.0), nothing
    if not len(bundle.edges):
        return values, nothing
    first_edge = np.searchsorted(bundle.edges[:, 1], np.arange(len(bundle.points) + 1)).astype(np.int32)
    free = np.arange(-1, len(bundle.poses) - 1, dtype=np.int32)
    for factor in sigmas:
        at, slopes = corrected(bundle, values)
        observed = Observations(first_edge, at.edges, at.measured, at.weights / factor**2, at.intrinsics)
        poses, points, agree = adjust(at.poses, free, at.points, observed, _NO_LINKS, _ROUNDS, _ITERATIONS)
        bundle = replace(bundle, poses=poses, points=points)
        information, gradient = common_parameters(poses, free, points, observed, agree, slopes)
        if np.linalg.eigvalsh(information + prior)[0] <= 0.0:
            return np.zeros(parameters), nothing
        step = -np.linalg.solve(information + prior, gradient + prior @ values)
        step /= max(1.0, (np.abs(step) / max_steps).max())
        values = values + step
        if factor == 1.0 and step @ (information + prior) @ step < parameters * _CONVERGED_SIGMAS**2:
            break
    return values, information


class WindowEstimates:
    """Estimates of parameters in windows that share no observation, whose spread gives the uncertainty."""

    def __init__(self, prior_sigmas: Array, max_steps: Array, *, sigmas: Sequence[float], least: int) -> None:
        """Start without any.

        Args:
            prior_sigmas: As for ``estimated``.
            max_steps: As for ``estimated``.
            sigmas: As for ``estimated``.
            least: With fewer windows there is no estimate.
        """
        self._prior_sigmas, self._max_steps, self._sigmas = prior_sigmas, max_steps, sigmas
        self._least = least
        self._values: list[Array] = []
        self._information: list[Array] = []

    @property
    def are_complete(self) -> bool:
        """Whether enough windows were added."""
        return len(self._values) >= _MAX_WINDOWS

    def add(self, bundle: Bundle, corrected: Corrected) -> None:
        """Add the estimate of a window's bundle, unless that tells nothing."""
        values, information = estimated(
            bundle,
            corrected,
            prior_sigmas=self._prior_sigmas,
            max_steps=self._max_steps,
            sigmas=self._sigmas,
        )
        if information.any():
            self._values.append(values)
            self._information.append(information)

    def mean(self) -> tuple[Array, Array] | None:
        """Return the (N,) means and their standard deviations; None where windows are too few."""
        if len(self._values) < self._least:
            return None
        values, information = np.array(self._values), np.array(self._information)
        total = information.sum(axis=0) + np.diag(self._prior_sigmas**-2.0)
        mean: Array = np.linalg.solve(total, np.einsum("kij,kj->i", information, values))
        apart = values - mean
        excess = float(np.einsum("ki,kij,kj->", apart, information, apart)) / (values.size - len(mean))
        sigma: Array = np.sqrt(max(excess, 1.0) * np.diag(np.linalg.inv(total)))
        return mean, sigma


class NestedEstimates:
    """Estimates of some parameters with more of them, which are dropped where they may be nothing.

    Those hardly differ from the first ones in what they do, so that these are less certain with them.
    """

    def __init__(
        self, prior_sigmas: Array, max_steps: Array, *, first: int, sigmas: Sequence[float], least: int
    ) -> None:
        """Start without any.

        Args:
            prior_sigmas: (N,) as for ``estimated``.
            max_steps: (N,) as for ``estimated``.
            first: The number of parameters that are estimated without the others.
            sigmas: As for ``estimated``.
            least: As for ``WindowEstimates``.
        """
        self._first, self._more = first, len(prior_sigmas) - first
        self._all = WindowEstimates(prior_sigmas, max_steps, sigmas=sigmas, least=least)
        self._some = WindowEstimates(prior_sigmas[:first], max_steps[:first], sigmas=sigmas, least=least)

    @property
    def are_complete(self) -> bool:
        """Whether enough windows were added."""
        return self._all.are_complete

    def add(self, bundle: Bundle, corrected: Corrected) -> None:
        """Add the estimates of a window's bundle, unless that tells nothing."""

        def corrected_by_first(bundle: Bundle, values: Array) -> tuple[Bundle, Array]:
            changed, slopes = corrected(bundle, np.append(values, np.zeros(self._more)))
            return changed, slopes[: self._first]

        self._all.add(bundle, corrected)
        self._some.add(bundle, corrected_by_first)

    def mean(self, *, least: Array, min_sigmas: float) -> tuple[Array, Array] | None:
        """Return the (N,) means and their standard deviations; None where windows are too few.

        Args:
            least: As for ``are_significant``, of those that are not first ones: where none is, they are 0.
            min_sigmas: Likewise.
        """
        found = self._all.mean()
        if found is None:
            return None
        values, sigmas = (figures[self._first :] for figures in found)
        if are_significant(values, sigmas, least=least, min_sigmas=min_sigmas).any():
            return found
        some = self._some.mean()
        nothing = np.zeros(self._more)
        return None if some is None else (np.append(some[0], nothing), np.append(some[1], nothing))


def are_significant(values: Array, sigmas: Array, *, least: Array, min_sigmas: float) -> NDArray[np.bool_]:
    """Return (N,) which values are large enough to count, and certainly not 0.

    Args:
        values: (N,).
        sigmas: (N,) their standard deviations.
        least: (N,) from where on they count.
        min_sigmas: Number of standard deviations from which on they are not 0.
    """
    significant: NDArray[np.bool_] = np.abs(values) >= np.maximum(least, min_sigmas * sigmas)
    return significant
