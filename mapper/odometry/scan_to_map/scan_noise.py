"""Covariance of a scan's pose relative to its keyframe, from what the log itself shows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform, angle_between
from mapper.odometry.scan_to_map.scan_fit import ScanFit
from mapper.odometry.scan_to_map.usual_fit import Jump

_SECTORS = 12  # of azimuth, each of two elevations
_LEAST_RAD, _LEAST_M = 5e-4, 2e-3
_SHARE = 0.007
"""Of distance and angle: what a sensor's calibration adds, alike in all points; 7 mm on a metre in KITTI."""
_DOUBTFUL_RAD, _DOUBTFUL_M = 0.1, 0.5
_TRUSTED_MPS = 0.1  # what is predicted is doubtful from here on
_SHORTEST_S = 0.01


def surface_covariance(fit: ScanFit) -> Array:
    """Return the (6, 6) covariance of the scan's tangent from its distances to the keyframe's surfaces.

    Distances of neighbouring points share the errors of one normal, of the map and of the sensor, so their
    scores are summed over sectors before they are squared: H⁻¹ (Σ_c s_c s_cᵀ) H⁻¹ with s_c = Σ Jᵀr over a
    sector (Liang & Zeger 1986, eq. 8). To it comes the square of the step that would fit the scan to this
    keyframe best: a matcher that is biased, or a map that disagrees with the keyframe, is off by as much.

    Args:
        fit: With rows, distances and points.
    """
    rows, residuals_m = fit.rows, fit.residuals_m
    hessian = np.einsum("ni,nj->ij", rows, rows)
    scale = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
    clusters = _sectors(fit.points)
    scores: Array = np.stack([np.bincount(clusters, column * residuals_m) for column in rows.T], axis=1)
    used = int((np.bincount(clusters) > 0).sum())
    scaled = np.linalg.pinv(hessian / np.outer(scale, scale), rcond=1e-9, hermitian=True)
    steps = (scores / scale) @ scaled / scale
    whole = steps.sum(axis=0)
    covariance: Array = np.einsum("ci,cj->ij", steps, steps) * (used / max(used - 6, 1))
    return covariance + np.outer(whole, whole)


def _sectors(points: Array) -> NDArray[np.intp]:
    """Return the number of each point's sector about the sensor."""
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    around = np.minimum(((azimuth + np.pi) * (_SECTORS / (2.0 * np.pi))).astype(np.intp), _SECTORS - 1)
    return 2 * around + (points[:, 2] > np.median(points[:, 2]))


@dataclass(frozen=True, slots=True, eq=False)
class PoseNoise:
    """Covariance (6, 6) of a scan's pose in its tangent, and why it may be more than it says."""

    covariance: Array
    doubts: tuple[str, ...] = ()

    def inflated(self, jump: Jump) -> Array:
        """Return the covariance of a doubtful pose: wrong by as much as it lies off the prediction."""
        sigmas = np.array(
            [max(jump.rotation_rad, _DOUBTFUL_RAD)] * 3 + [max(jump.translation_m, _DOUBTFUL_M)] * 3
        )
        return self.covariance + np.diag(sigmas**2)


class ScanNoise:
    """Noise of poses relative to the last keyframe, with what was predicted since then."""

    def __init__(self) -> None:
        self._unseen = 0  # scans in a row that left a motion open
        self._steps = 0.0

    def restart(self) -> None:
        """Begin at a new keyframe."""
        self._steps = 0.0

    def of(
        self,
        fit: ScanFit,
        open_m: Array,
        T_key_scan: Transform,
        elapsed_s: float,
        at_stamps: Array,
    ) -> PoseNoise:
        """Return the noise of the next scan.

        Args:
            fit: On the keyframe.
            open_m: (6,) errors of its motions that were predicted instead of measured.
            T_key_scan: (4, 4) the pose relative to the keyframe.
            elapsed_s: Since the scan before.
            at_stamps: (6, 6) covariance of the motion from the stamps to the middles of both sweeps.
        """
        covariance = surface_covariance(fit)
        turned, moved = angle_between(np.eye(3), T_key_scan[:3, :3]), np.linalg.norm(T_key_scan[:3, 3])
        least = np.hypot([_LEAST_RAD] * 3 + [_LEAST_M] * 3, [_SHARE * turned] * 3 + [_SHARE * moved] * 3)
        covariance = covariance + np.diag(least**2) + at_stamps
        if fit.observability.min() >= 1.0:
            self._unseen = 0
            return PoseNoise(covariance)
        self._unseen += 1
        self._steps += self._unseen
        motions = fit.degeneracy.motions
        added_m = np.minimum(open_m * self._steps, fit.degeneracy.extent_m)
        predicted = np.einsum("ki,k,kj->ij", motions, added_m**2, motions)
        rate_mps = float(open_m.max()) * self._unseen / max(elapsed_s, _SHORTEST_S)
        doubts: tuple[str, ...] = ()
        if rate_mps > _TRUSTED_MPS:
            name = fit.unobservable or "a motion"
            doubts = (f"{name} is not seen but predicted, to ±{rate_mps:.2f} m a second",)
        return PoseNoise(covariance + predicted, doubts)
