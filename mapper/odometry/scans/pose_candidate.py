"""Candidate for the pose of a scan: its fit to a keyframe, fused with the predicted motion."""

from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array, Transform, exp, inverse, length_and_angle, log
from mapper.odometry.base import Diagnostics
from mapper.odometry.scans.motion_model import Spread
from mapper.odometry.scans.scan_fit import ScanFit, ScanKeyframe

_JUMP_SPREADS = 8.0
_LEAST_JUMP_M, _LEAST_JUMP_RAD = 0.15, 0.09
_CONTRADICTION_WEIGHT = 15.0
_UNSHOWN_VOXELS = 0.5  # error of a measured motion that next to no surface shows
_MOST_SIGMAS = 3.0
_SURE = 0.98  # probability that surfaces show a motion
_WHEEL_SIGMAS = 2.0  # for the tails of their errors: wheels slip now and then
_SLIDING_VOXELS = 2.5
_UNKNOWN_PARTS = 0.1  # share of the extent by which a prediction is off before any could be compared


@dataclass(frozen=True, slots=True)
class Shares:
    """Shares of one scan's points under a pose.

    Attributes:
        overlap: With a partner on the keyframe.
        agreement: On its surfaces, in the direction where the least agree.
        contradicting: In space that rays passed.
    """

    overlap: float
    agreement: float
    contradicting: float

    @property
    def score(self) -> float:
        """Agreement less what contradicts, weighted; overlap says little, as ground lies on any ground."""
        return self.agreement - _CONTRADICTION_WEIGHT * self.contradicting


@dataclass(frozen=True, slots=True)
class Jump:
    """Deviation from the predicted pose, and how much would be a surprise."""

    translation_m: float
    rotation_rad: float
    limit_m: float
    limit_rad: float

    @property
    def is_unusual(self) -> bool:
        """Whether it is a surprise."""
        return self.translation_m > self.limit_m or self.rotation_rad > self.limit_rad

    @property
    def text(self) -> str:
        """Both in words."""
        return (
            f"jump of {self.translation_m:.2f} m and {np.degrees(self.rotation_rad):.0f}° from the predicted "
            f"pose, the limits being {self.limit_m:.2f} m and {np.degrees(self.limit_rad):.0f}°"
        )


def jump_between(T_world_predicted: Transform, T_world_found: Transform, spread: Spread | None) -> Jump:
    """Return how far a pose lies from the predicted one; without a known spread nothing is a surprise."""
    error = inverse(T_world_predicted) @ T_world_found
    limits = (np.inf, np.inf)
    if spread is not None:
        limits = (
            max(_JUMP_SPREADS * spread.translation_m, _LEAST_JUMP_M),
            max(_JUMP_SPREADS * spread.rotation_rad, _LEAST_JUMP_RAD),
        )
    return Jump(*length_and_angle(error), *limits)


@dataclass(frozen=True, slots=True, eq=False)
class PoseCandidate:
    """A pose of the body in the middle of a scan's sweep.

    Attributes:
        keyframe: Keyframe that it was compared with.
        T_world_middle: (4, 4) the pose.
        fit: Fit to that keyframe.
        shares: Shares on this keyframe and the scans about it, compared with those of the log.
        jump: Deviation from the predicted pose.
        open_m: (6,) errors of the motions that were predicted instead of measured.
        method: Step that found it.
    """

    keyframe: ScanKeyframe
    T_world_middle: Transform
    fit: ScanFit
    shares: Shares
    jump: Jump
    open_m: Array
    method: str

    @property
    def is_measured(self) -> bool:
        """Whether surfaces surely show all of the motion."""
        return bool(self.fit.observability.min() >= _SURE)

    @property
    def score(self) -> float:
        """Score of its shares."""
        return self.shares.score

    def diagnostics(self, *, points: int) -> Diagnostics:
        """Return the figures of a scan of some points at this pose."""
        return Diagnostics(
            features=points,
            matches=points,
            inliers=len(self.fit.points),
            residual=self.fit.rmse_m,
            residual_unit="m",
            method=self.method,
            unobservable=self.fit.unobservable,
        )


def fuse_with_prediction(
    fit: ScanFit,
    T_world_predicted: Transform,
    T_world_found: Transform,
    spread: Spread | None,
    *,
    voxel_m: float,
) -> tuple[Transform, Array]:
    """Return the found pose with its unobserved motions as predicted (Zhang, Kaess & Singh 2016, §IV).

    Unlike there a motion that is not shown is not dropped at once: it is weighed against the prediction with
    an error of part of a voxel, since by hand at two scans a second a prediction is worth even less. A motion
    that surfaces show with some probability is the mean of both cases, with the variance of their mixture.

    Args:
        fit: Of the found pose.
        T_world_predicted: (4, 4) by constant velocity.
        T_world_found: (4, 4) by the matcher.
        spread: Of the prediction; None if it is not known yet.
        voxel_m: Of the scan.

    Returns:
        (4, 4) pose, and (6,) standard deviation of each of the fit's motions beyond that of what was
        measured: how far it displaces the points, metres.
    """
    shown = fit.observability
    if shown.min() >= 1.0:
        return T_world_found, np.zeros(6)
    motions, found_m = fit.degeneracy.motions, _UNSHOWN_VOXELS * voxel_m
    to_motions = np.linalg.inv(motions.T)
    if spread is None:
        predicted_m = np.full(6, _UNKNOWN_PARTS * fit.degeneracy.extent_m)
    else:
        each = np.array([spread.rotation_rad] * 3 + [spread.translation_m] * 3)
        predicted_m = np.linalg.norm(to_motions * each, axis=1)
    corrections_m = to_motions @ np.concatenate(log(inverse(T_world_predicted) @ T_world_found))
    if spread is not None and spread.is_by_wheels:
        shown = _shown_given(shown, np.asarray(corrections_m, np.float64), predicted_m, voxel_m)
    gains = predicted_m**2 / (predicted_m**2 + found_m**2)
    gains[np.abs(corrections_m) > _MOST_SIGMAS * np.hypot(predicted_m, found_m)] = 0.0
    weights = shown + (1.0 - shown) * gains
    kept = motions.T @ (weights * corrections_m)
    left = (1.0 - shown) * (1.0 - gains)
    open_m = np.sqrt(left * (predicted_m**2 + shown * (1.0 - gains) * corrections_m**2))
    return T_world_predicted @ exp(kept[:3], kept[3:]), open_m


def _shown_given(shown: Array, corrections_m: Array, predicted_m: Array, voxel_m: float) -> Array:
    """Return (6,) probabilities that surfaces show motions, given how much these correct the wheels'.

    By Bayes' rule: a motion that is shown corrects as much as wheels err, one that is not by as much as a
    match may slide, any correction within some voxels alike.
    """
    sigmas_m = _WHEEL_SIGMAS * predicted_m
    if_shown = np.exp(-0.5 * (corrections_m / sigmas_m) ** 2) / (np.sqrt(2.0 * np.pi) * sigmas_m)
    if_not = 1.0 / (2.0 * _SLIDING_VOXELS * voxel_m)
    chance = shown * if_shown + (1.0 - shown) * if_not
    return np.where(shown >= 1.0, shown, shown * if_shown / np.where(shown >= 1.0, 1.0, chance))
