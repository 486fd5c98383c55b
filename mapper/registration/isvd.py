"""ISVD: iterative SVD on matched points (Somlyai, PhD thesis, alg. 5–7, eq. 4.1–4.2)."""

from collections.abc import Iterator

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform, apply, fit_rigid, transform
from mapper.core.units import MM_PER_M
from mapper.registration.base import Alignment, failed
from mapper.registration.config import IsvdConfig

_MIN_SPREAD_M = 0.01  # about a common line, points nearer to it than this leave the rotation unobservable
_MIN_SIGMA_M = 1e-3  # trimming must not make the pairs better than the sensor
_ICP_STEPS = 20
_MIN_PAIRS = 100
"""Trimming stops before fewer than these, or than half of a smaller set, would remain ("Auto")."""
_START_ERROR_MM = 1000.0  # e_start of the halving threshold, which the thesis leaves open


class Isvd:
    """ISVD: fit a motion to matched points, drop the pairs beyond a shrinking threshold, fit again."""

    def __init__(self, config: IsvdConfig) -> None:
        self._config = config

    def fit(self, target: Points, source: Points) -> Alignment:
        """Return the motion that takes the source points to their target partners.

        Args:
            target: (N, 3) points in the target frame, metres (the thesis's D).
            source: (N, 3) their partners in the source frame, metres (the thesis's S).

        Returns:
            The alignment. Its ratio, residual and information are those of all pairs within
            ``agreement_mm``; it has not converged when there are too few of them.
        """
        return self.fit_weighted(target, source)[0]

    def fit_weighted(self, target: Points, source: Points) -> tuple[Alignment, float]:
        """Return ``fit``'s alignment and its quality W in 1/m (eq. 4.1), 0 when it did not converge."""
        config = self._config
        if len(target) < config.min_agreeing:
            return failed(f"{len(target)} pairs with depth, fewer than {config.min_agreeing}"), 0.0
        T_target_source, used = self.trim_pairs(target, source)
        residuals = target - apply(T_target_source, source)
        distances = np.linalg.norm(residuals, axis=1)
        agreeing = distances <= config.agreement_mm / MM_PER_M
        ratio = float(agreeing.mean())
        if agreeing.sum() < config.min_agreeing or ratio < config.min_agreement_ratio:
            return failed(
                f"{agreeing.sum()} of {len(target)} pairs agree within {config.agreement_mm} mm"
            ), 0.0
        spread_m = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(source[agreeing].T)), 0.0))
        if spread_m[1] < _MIN_SPREAD_M:
            return failed(f"the pairs lie within {1e3 * spread_m[1]:.1f} mm of a line"), 0.0
        weight = 1.0 / max(float(np.abs(residuals[used]).sum(axis=1).mean()), np.finfo(float).eps)
        alignment = Alignment(
            T_target_source,
            converged=True,
            inlier_ratio=ratio,
            inlier_rmse_m=float(np.sqrt((distances[agreeing] ** 2).mean())),
            pairs=int(agreeing.sum()),
            information=rigid_fit_information(source[agreeing], distances[agreeing]),
        )
        return alignment, weight

    def trim_pairs(self, target: Points, source: Points) -> tuple[Transform, NDArray[np.intp]]:
        """Return the (4, 4) motion of the last iteration, and the indices of the pairs it was fitted to.

        Args:
            target: (N, 3) metres, N ≥ 3.
            source: (N, 3) their partners, metres.
        """
        config = self._config
        enough = max(min(_MIN_PAIRS, len(target) // 2), 3)
        if config.step == "icp":
            return self._trim_by_icp(target, source, enough)
        R, t, used = trim(
            np.ascontiguousarray(target),
            np.ascontiguousarray(source),
            np.array([*self._thresholds_m()]),
            config.min_error_mm / MM_PER_M,
            enough,
        )
        return transform(R, t), used

    def _trim_by_icp(self, target: Points, source: Points, enough: int) -> tuple[Transform, NDArray[np.intp]]:
        """Return the same by algorithm 5, whose iterations find their pairs anew."""
        T_target_source = np.eye(4)
        used = kept = np.arange(len(target), dtype=np.intp)
        for threshold_m in self._thresholds_m():
            used = kept
            T_target_source = _icp(target[used], source[used], T_target_source)
            distances = np.linalg.norm(target[used] - apply(T_target_source, source[used]), axis=1)
            kept = used[distances <= threshold_m]
            if threshold_m * MM_PER_M < self._config.min_error_mm or len(kept) < enough:
                break
        return T_target_source, used

    def _thresholds_m(self) -> Iterator[float]:
        """Yield each iteration's largest pair distance: the power law (eq. 4.2) or the halving (alg. 6)."""
        config = self._config
        for j in range(1, config.max_iterations + 1):
            if config.threshold == "power":
                yield config.alpha_mm * j**config.beta / MM_PER_M  # eq. 4.2
            else:
                yield _START_ERROR_MM * 0.5 ** (j - 1) / MM_PER_M


def rigid_fit_information(source: Points, distances_m: Array) -> Array:
    """Return the (6, 6) Fisher information of a rigid fit for the source's tangent (rotation, translation).

    A pair's residual d - T·s changes by -R·(ω × s + v) when T is multiplied by exp(ω, v) on the right.
    With equal, independent noise σ on each axis the pairs' information is Σ JᵀJ / σ², where J = [-[s]×, I];
    σ² is the residual variance at 3N - 6 degrees of freedom. Points spread wide fix the rotation, many
    points the translation, and directions that they leave uncertain stay uncertain in the pose graph.

    Args:
        source: (N, 3) points in the source frame, metres.
        distances_m: (N,) lengths of the residuals.
    """
    n = len(source)
    sigma_m = max(float(np.sqrt((distances_m**2).sum() / max(3 * n - 6, 1))), _MIN_SIGMA_M)
    x, y, z = source.sum(axis=0)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    squares = source.T @ source
    information = np.empty((6, 6))
    information[:3, :3] = np.trace(squares) * np.eye(3) - squares  # Σ -[s]×²
    information[:3, 3:] = cross
    information[3:, :3] = cross.T
    information[3:, 3:] = n * np.eye(3)
    return information / sigma_m**2


def _icp(target: Points, source: Points, T_target_source: Transform) -> Transform:
    """Return point-to-point ICP's motion from a first guess (Besl & McKay 1992)."""
    nearest = np.empty(0, np.intp)
    for _ in range(_ICP_STEPS):
        moved = apply(T_target_source, source)
        squared = (moved**2).sum(axis=1)[:, None] - 2.0 * moved @ target.T + (target**2).sum(axis=1)
        before, nearest = nearest, squared.argmin(axis=1)
        if np.array_equal(before, nearest):
            break
        T_target_source, _ = fit_rigid(target[nearest], source)
    return T_target_source


@njit(cache=True, nogil=True)
def trim(
    target: Points, source: Points, thresholds_m: Array, min_error_m: float, enough: int
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Fit a motion to pairs, drop those beyond the iteration's threshold, and fit again (alg. 7).

    Args:
        target: (N, 3) points, metres, N ≥ 3.
        source: (N, 3) their partners.
        thresholds_m: (M,) largest distance of a pair in each iteration, M ≥ 1.
        min_error_m: The iteration whose threshold falls below this is the last.
        enough: So is one that would leave fewer pairs than this.

    Returns:
        (3, 3) rotation and (3,) translation of the last iteration, and the indices of the pairs they were
        fitted to.
    """
    R, t = np.eye(3), np.zeros(3)
    used = np.arange(len(target))
    kept = used
    for threshold_m in thresholds_m:
        used = kept
        R, t = _fit(target, source, used)
        kept = used.copy()
        count = 0
        for i in used:
            squared = 0.0
            for k in range(3):
                miss = target[i, k] - t[k]
                for m in range(3):
                    miss -= R[k, m] * source[i, m]
                squared += miss * miss
            if squared <= threshold_m * threshold_m:
                kept[count] = i
                count += 1
        kept = kept[:count]
        if threshold_m < min_error_m or count < enough:
            break
    return R, t, used


@njit(cache=True, nogil=True)
def _fit(target: Points, source: Points, used: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return the rotation and translation of the used pairs, as ``core.geometry.fit_rigid`` does."""
    target_mean, source_mean = np.zeros(3), np.zeros(3)
    for i in used:
        for k in range(3):
            target_mean[k] += target[i, k]
            source_mean[k] += source[i, k]
    target_mean /= len(used)
    source_mean /= len(used)
    covariance = np.zeros((3, 3))
    for i in used:
        for k in range(3):
            for m in range(3):
                covariance[k, m] += (target[i, k] - target_mean[k]) * (source[i, m] - source_mean[m])
    U, _, Vt = np.linalg.svd(covariance)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0.0:
        U[:, 2] = -U[:, 2]
    R = U @ Vt
    return R, target_mean - R @ source_mean
