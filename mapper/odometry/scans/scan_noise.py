"""Covariance of a scan's pose relative to its keyframe, from what the log itself shows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.doubts import Doubt
from mapper.core.geometry import Array, Transform, length_and_angle
from mapper.core.linear import gram
from mapper.graph.config import WheelNoiseConfig
from mapper.graph.wheel_factors import wheel_sigmas
from mapper.odometry.scans.pose_candidate import Jump
from mapper.odometry.scans.scan_fit import ScanFit

_SECTORS = 12  # of azimuth, each of two elevations
_IN_PLANE = slice(2, 5)  # yaw, x and y of a tangent
_LEAST_SHARE, _LEAST_SCATTER = 1e-9, 1e-2  # relative to the best known motion; to independent distances
_SCATTER = 0.75
"""Weight of the scatter in the mean: with a half, one second in a bare field was 0.3 m and 6 sigma off."""
_LEAST_RAD, _LEAST_M = 1e-5, 1e-4
_MODEL_RAD_M, _MODEL_M_M, _MODEL_SHARE_M = 0.02, 0.08, 0.28
"""What a sensor's calibration adds, alike in all points, for each metre of the median distance from surfaces:
of rotation, of translation and of the share of the way. KITTI's scans lie 25 mm off surfaces, and their poses
7 mm on a metre, an error of 0.2° of the beams' elevations; synthetic ones lie 6 mm off, and are exact."""
_DOUBTFUL_RAD, _DOUBTFUL_M = 0.1, 0.5
_TRUSTED_MPS, _TRUSTED_M = 0.1, 0.05
"""A prediction is doubtful when it may be off by more than both: single scans of stairs leave turns open by
2 cm, and are right."""
_SHORTEST_S = 0.01


def surface_covariance(fit: ScanFit) -> Array:
    """Return the (6, 6) covariance of the scan's tangent from its distances to the keyframe's surfaces.

    Distances of neighbouring points share the errors of one normal, of the map and of the sensor, so that
    σ²H⁻¹, which takes them for independent, is too small. The scatter of the steps of 24 sectors (Liang &
    Zeger 1986, eq. 8) allows for that, but takes for errors of the pose what a map of many keyframes
    averages. The result is their geometric mean, weighted 1 : 3. Of planar scans z and tilt have no
    covariance.

    Args:
        fit: With rows, distances and points.
    """
    measured = _IN_PLANE if fit.is_planar else slice(6)
    rows, residuals_m = fit.rows[:, measured], fit.residuals_m
    hessian = gram(rows, rows)
    scale = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
    known, motions = np.linalg.eigh(hessian / np.outer(scale, scale))
    sigmas = np.maximum(known, _LEAST_SHARE * known[-1]) ** -0.5
    sectors = _sectors(fit.points)
    variance = float(np.mean(residuals_m**2))
    if variance == 0.0:
        return np.zeros((6, 6))
    gradients = np.stack([np.bincount(sectors, column * residuals_m) for column in rows.T], axis=1)
    steps: Array = (gradients / scale) @ (motions * (sigmas / np.sqrt(variance)))
    used = len(np.unique(sectors))
    freedom = rows.shape[1]
    scatter, axes = np.linalg.eigh(np.einsum("ci,cj->ij", steps, steps) * (used / max(used - freedom, 1)))
    scatter = np.maximum(scatter, _LEAST_SCATTER)
    to_tangent = (motions * (sigmas * np.sqrt(variance))) @ axes / scale[:, None]
    covariance = np.zeros((6, 6))
    covariance[measured, measured] = (to_tangent * scatter**_SCATTER) @ to_tangent.T
    return covariance


def _sectors(points: Array) -> NDArray[np.intp]:
    """Return the number of each point's sector about the sensor."""
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    around = np.minimum(((azimuth + np.pi) * (_SECTORS / (2.0 * np.pi))).astype(np.intp), _SECTORS - 1)
    return 2 * around + (points[:, 2] > np.median(points[:, 2]))


def _with_wheels(covariance: Array, T_key_scan: Transform, noise: WheelNoiseConfig) -> Array:
    """Return the (6, 6) covariance of a pose that surfaces and wheels measured."""
    sigmas = wheel_sigmas(noise, *length_and_angle(T_key_scan))
    variances = np.square([sigmas.rotation_rad] * 3 + [sigmas.translation_m] * 3)
    reduced: Array = covariance - covariance @ np.linalg.solve(covariance + np.diag(variances), covariance)
    return 0.5 * (reduced + reduced.T)


@dataclass(frozen=True, slots=True, eq=False)
class PoseNoise:
    """Covariance (6, 6) of a scan's pose in its tangent, and why it may be more than it says."""

    covariance: Array
    doubts: tuple[Doubt, ...] = ()

    def inflated(self, jump: Jump) -> Array:
        """Return the covariance of a doubtful pose: wrong by as much as it lies off the prediction."""
        sigmas = np.array(
            [max(jump.rotation_rad, _DOUBTFUL_RAD)] * 3 + [max(jump.translation_m, _DOUBTFUL_M)] * 3
        )
        return self.covariance + np.diag(sigmas**2)


class ScanNoise:
    """Noise of poses relative to the last keyframe, with what was predicted since then."""

    def __init__(self, wheels: WheelNoiseConfig) -> None:
        self._wheels = wheels
        self._unseen = 0.0  # scans in a row that left a motion open, each by the probability that it did
        self._steps = 0.0  # their sums since the keyframe

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
        *,
        is_by_wheels: bool = False,
    ) -> PoseNoise:
        """Return the noise of the next scan.

        Args:
            fit: On the keyframe.
            open_m: (6,) errors of its motions that were predicted instead of measured.
            T_key_scan: (4, 4) the pose relative to the keyframe.
            elapsed_s: Since the scan before.
            at_stamps: (6, 6) covariance of the motion from the stamps to the middles of both sweeps.
            is_by_wheels: Wheels predicted the pose: their errors do not add up as those of a velocity do, and
                limit how far it is off where surfaces show little.
        """
        covariance = surface_covariance(fit)
        if is_by_wheels:
            covariance = _with_wheels(covariance, T_key_scan, self._wheels)
        off_m, moved_m = float(np.median(np.abs(fit.residuals_m))), float(np.linalg.norm(T_key_scan[:3, 3]))
        least_rad = _LEAST_RAD + _MODEL_RAD_M * off_m
        least_m = np.hypot(_LEAST_M + _MODEL_M_M * off_m, _MODEL_SHARE_M * off_m * moved_m)
        covariance = covariance + np.diag(np.square([least_rad] * 3 + [least_m] * 3)) + at_stamps
        is_open = 1.0 - float(fit.observability.min())
        self._unseen = 1.0 + is_open * self._unseen * (not is_by_wheels)
        self._steps = self._unseen + is_open * self._steps
        motions = fit.degeneracy.motions
        added_m = np.minimum(open_m * self._steps, fit.degeneracy.extent_m)
        predicted = np.einsum("ki,k,kj->ij", motions, added_m**2, motions)
        rate_mps = float(open_m.max()) * self._unseen / max(elapsed_s, _SHORTEST_S)
        doubts: tuple[Doubt, ...] = ()
        if rate_mps > _TRUSTED_MPS and added_m.max() > _TRUSTED_M:
            name = fit.unobservable or "a motion"
            doubts = (
                Doubt("unobservable", f"{name} is not seen but predicted, to ±{rate_mps:.2f} m a second"),
            )
        return PoseNoise(covariance + predicted, doubts)
