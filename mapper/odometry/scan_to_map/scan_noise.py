"""Covariance of a scan's pose relative to its keyframe, from what the log itself shows."""

from dataclasses import dataclass, replace

import numpy as np

from mapper.core.doubts import Doubt
from mapper.core.geometry import Array, Transform, adjoint, inverse
from mapper.odometry.base import UnseenMotions
from mapper.odometry.scan_to_map.observed_part import Blend
from mapper.odometry.scan_to_map.scan_fit import ScanFit
from mapper.odometry.scan_to_map.usual_fit import Jump

_LEAST_RAD, _LEAST_M = 1e-5, 1e-4
_MODEL_RAD_M, _MODEL_M_M, _MODEL_SHARE_M = 0.02, 0.08, 0.28
"""What a sensor's calibration adds, alike in all points, for each metre of the median distance from surfaces:
of rotation, of translation and of the share of the way. KITTI's scans lie 25 mm off surfaces, and their poses
7 mm on a metre, an error of 0.2° of the beams' elevations; synthetic ones lie 6 mm off, and are exact."""
_DOUBTFUL_RAD, _DOUBTFUL_M = 0.1, 0.5
_TRUSTED_RADPS, _TRUSTED_MPS = 0.088, 0.2
TRUSTED_RAD, TRUSTED_M = 0.044, 0.1
"""A prediction is doubtful when its rotation or its translation may be off by more than both: with two sigmas
by 5 degrees or 0.2 m, which is wrong. With a half, 1 to 4 % more of the right scans of fields are flagged."""
_SHORTEST_S = 0.01
_A_MOTION = "a motion"


def independent_covariance(fit: ScanFit, blend: Blend) -> Array:
    """Return the (6, 6) covariance of a pose without the errors that the last pose has alike.

    That is of the distances, and of what these leave open; what few pairs show, the same ones show both.
    """
    return fit.surface_covariance + _along(fit, blend.open_m)


def _along(fit: ScanFit, sigmas_m: Array) -> Array:
    """Return the (6, 6) covariance of the fit's motions with (6,) standard deviations."""
    motions = fit.degeneracy.motions
    return np.asarray(np.einsum("ki,k,kj->ij", motions, sigmas_m**2, motions), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class PoseNoise:
    """Noise of a scan's pose, in its tangent.

    Attributes:
        covariance: (6, 6) relative to the keyframe.
        independent: (6, 6) of what the last pose does not have alike.
        unseen: Motions whose prediction is doubtful, or made without a velocity; None if there are none.
    """

    covariance: Array
    independent: Array
    unseen: UnseenMotions | None = None

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """Why it may be more than that."""
        return () if self.unseen is None else self.unseen.doubts

    def with_more(self, covariance: Array) -> "PoseNoise":
        """Return the noise with a (6, 6) covariance added to what surfaces show."""
        unseen = self.unseen
        if unseen is not None:
            unseen = replace(unseen, covariance=unseen.covariance + covariance)
        return replace(self, covariance=self.covariance + covariance, unseen=unseen)


def doubtful_covariance(jump: Jump) -> Array:
    """Return the (6, 6) covariance that a doubtful pose has more: as much as it lies off the prediction."""
    sigmas = [max(jump.rotation_rad, _DOUBTFUL_RAD)] * 3 + [max(jump.translation_m, _DOUBTFUL_M)] * 3
    return np.diag(np.square(sigmas))


class ScanNoise:
    """Noise of poses relative to the last keyframe, with what was predicted since then."""

    def __init__(self) -> None:
        self._unseen = 0  # scans in a row that left a motion open
        self._unseen_s = 0.0
        self._steps = 0.0
        self._since_seen = PredictedPart()

    def restart(self) -> None:
        """Begin at a new keyframe."""
        self._steps = 0.0

    def of(
        self,
        fit: ScanFit,
        blend: Blend,
        T_key_scan: Transform,
        T_last_scan: Transform,
        elapsed_s: float,
        at_stamps: Array,
    ) -> PoseNoise:
        """Return the noise of the next scan.

        Args:
            fit: On the keyframe.
            blend: Of what was found and what was predicted.
            T_key_scan: (4, 4) the pose relative to the keyframe.
            T_last_scan: (4, 4) relative to the scan before.
            elapsed_s: Since the scan before.
            at_stamps: (6, 6) covariance of the motion from the stamps to the middles of both sweeps.
        """
        surface = fit.surface_covariance
        independent = surface + _along(fit, blend.open_m)
        off_m, moved_m = float(np.median(np.abs(fit.residuals_m))), float(np.linalg.norm(T_key_scan[:3, 3]))
        least_rad = _LEAST_RAD + _MODEL_RAD_M * off_m
        least_m = np.hypot(_LEAST_M + _MODEL_M_M * off_m, _MODEL_SHARE_M * off_m * moved_m)
        measured = surface + np.diag(np.square([least_rad] * 3 + [least_m] * 3)) + at_stamps
        covariance = measured + _along(fit, fit.observability * fit.shown_m)
        unseen, step = self._since_seen.add(blend, T_last_scan, elapsed_s)
        if fit.observability.min() >= 1.0:
            self._unseen, self._unseen_s = 0, 0.0
            return PoseNoise(covariance, independent)
        self._unseen += 1
        self._unseen_s += elapsed_s
        self._steps += self._unseen
        predicted_m = np.minimum(blend.open_m * self._steps, fit.degeneracy.extent_m)
        predicted = _along(fit, np.hypot(predicted_m, blend.unknown_mps * self._unseen_s))
        rates = largest_sigmas(step) / max(elapsed_s, _SHORTEST_S)
        (sigma_rad, sigma_m), (rate_radps, rate_mps) = largest_sigmas(unseen), rates
        doubts: tuple[Doubt, ...] = ()
        turns = rate_radps > _TRUSTED_RADPS and sigma_rad > TRUSTED_RAD
        if turns or (rate_mps > _TRUSTED_MPS and sigma_m > TRUSTED_M):
            doubts = (predicted_motion(fit.unobservable, rate_radps, rate_mps),)
            if blend.unknown_mps.any():
                name = fit.unobservable or _A_MOTION
                text = f"{name} is not seen, and was not before: its velocity is unknown"
                doubts = (Doubt("unknown velocity", text),)
        poor = None
        if doubts or blend.unknown_mps.any():
            poor = _unseen_motions(fit, blend, measured, doubts)
        return PoseNoise(covariance + predicted, independent, poor)


def predicted_motion(unobservable: str, sigma_rad: float, sigma_m: float) -> Doubt:
    """Return the doubt about a motion that is predicted.

    Args:
        unobservable: Its name; empty if it has none.
        sigma_rad: Standard deviation of the rotation in a second.
        sigma_m: Of the translation.
    """
    known = f"±{sigma_m:.2f} m and {np.degrees(sigma_rad):.1f}° a second"
    return Doubt("predicted motion", f"{unobservable or _A_MOTION} is not seen but predicted, to {known}")


def information_of(covariance: Array) -> Array:
    """Return the (6, 6) information of a covariance, symmetric to the last digit."""
    information = np.asarray(np.linalg.inv(covariance), np.float64)
    return 0.5 * (information + information.T)


def _unseen_motions(fit: ScanFit, blend: Blend, measured: Array, doubts: tuple[Doubt, ...]) -> UnseenMotions:
    """Return the motions of a fit that surfaces do not show in full.

    Args:
        fit: The fit.
        blend: Of what was found and what was predicted.
        measured: (6, 6) covariance without what few pairs show.
        doubts: Because of these motions.
    """
    motions, is_unseen = fit.degeneracy.motions, fit.observability < 1.0
    parts = np.asarray(np.linalg.inv(motions.T), np.float64)
    few_m = fit.observability * fit.shown_m
    return UnseenMotions(
        motions[is_unseen],
        parts[is_unseen],
        np.hypot(blend.shown_m, few_m)[is_unseen],
        measured + _along(fit, np.where(is_unseen, 0.0, few_m)),
        doubts,
    )


class PredictedPart:
    """Covariance of a pose of which motions are predicted, by adding the last step to the last pose.

    The errors of both are followed together, since these motions were last seen: those that stay unseen go on
    with the error of the velocity, and those that are partly seen are corrected.
    """

    def __init__(self) -> None:
        self._covariance = np.zeros((12, 12))  # of the pose and of the last step, scan's tangent
        self._elapsed_s = 0.0

    def add(self, blend: Blend, T_last_scan: Transform, elapsed_s: float) -> tuple[Array, Array]:
        """Add a scan; return the (6, 6) covariances of its pose and of its step.

        pose' = (1 − gain) (pose + step) + gain found, and step' = pose' − pose.
        """
        Ad = adjoint(inverse(T_last_scan))
        kept = np.eye(6) - blend.gain
        ratio = elapsed_s / self._elapsed_s if self._elapsed_s > 0.0 else 1.0
        change = np.block([[kept @ Ad, ratio * kept @ Ad], [kept @ Ad - Ad, ratio * kept @ Ad]])
        added = kept @ blend.predicted @ kept.T + blend.found
        self._covariance = change @ self._covariance @ change.T + np.tile(added, (2, 2))
        self._elapsed_s = elapsed_s
        return self._covariance[:6, :6].copy(), self._covariance[6:, 6:].copy()


def largest_sigmas(covariance: Array) -> Array:
    """Return the largest standard deviation of a (6, 6) covariance's rotation and of its translation."""
    return np.sqrt([np.linalg.eigvalsh(covariance[part, part])[-1] for part in (slice(3), slice(3, 6))])
