"""Pose of which each motion is measured where surfaces show it, and predicted where they do not."""

from dataclasses import dataclass, field

import numpy as np

from mapper.core.geometry import Array, Transform, exp, inverse, log
from mapper.odometry.scan_to_map.motion_model import Spread
from mapper.odometry.scan_to_map.scan_fit import ScanFit

_UNSHOWN_VOXELS = 0.5  # error of a measured motion that next to no surface shows
_LEAST_SHOWN = 1e-6  # keeps the error of a motion that is not shown finite
_MOST_SIGMAS = 3.0
_UNKNOWN_PARTS = 0.1  # share of the extent by which a prediction is off before any could be compared
_EXTENTS_PER_S = 1.0  # plausible speed through what is seen: 20 m/s on a road, 4 m/s in a room


@dataclass(frozen=True, slots=True, eq=False)
class Blend:
    """How a pose was made of a found and of a predicted one; all are of its tangent.

    Attributes:
        gain: (6, 6) what is taken of the found pose's difference from the predicted one.
        found: (6, 6) covariance that errors of unshown motions of the found pose bring with that.
        predicted: (6, 6) covariance of a pose predicted from known ones.
        open_m: (6,) standard deviation of each of the fit's motions beyond that of what was measured: how far
            it displaces the points, metres.
        shown_m: (6,) standard deviation with which surfaces show each of these motions, beyond that of what
            was measured.
        unknown_mps: (6,) standard deviation of the velocity of each of these motions, as it displaces the
            points, where it is not shown and no velocity was measured before.
    """

    gain: Array
    found: Array
    predicted: Array
    open_m: Array
    shown_m: Array = field(default_factory=lambda: np.zeros(6))
    unknown_mps: Array = field(default_factory=lambda: np.zeros(6))


MEASURED = Blend(np.eye(6), np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6))
"""Of a pose that is all measured."""


def observed_part(
    fit: ScanFit,
    T_world_predicted: Transform,
    T_world_found: Transform,
    spread: Spread | None,
    *,
    voxel_m: float,
) -> tuple[Transform, Blend]:
    """Return the found pose with its unobserved motions as predicted (Zhang, Kaess & Singh 2016, §IV).

    Unlike there a motion that is not shown is not dropped at once: it is weighed against the prediction with
    an error of part of a voxel, since by hand at two scans a second a prediction is worth even less.

    Args:
        fit: Of the found pose.
        T_world_predicted: (4, 4) by constant velocity.
        T_world_found: (4, 4) by the matcher.
        spread: Of the prediction; None if it is not known yet.
        voxel_m: Of the scan.

    Returns:
        (4, 4) pose, and what it was made of.
    """
    shown = fit.observability
    if shown.min() >= 1.0:
        return T_world_found, MEASURED
    motions, found_m = fit.degeneracy.motions, _UNSHOWN_VOXELS * voxel_m
    unknown_mps = np.zeros(6)
    to_motions = np.linalg.inv(motions.T)
    if spread is None:
        predicted_m = np.full(6, _UNKNOWN_PARTS * fit.degeneracy.extent_m)
        predicted = motions.T @ np.diag(predicted_m**2) @ motions
        unknown_mps = (1.0 - shown) * _EXTENTS_PER_S * fit.degeneracy.extent_m
    else:
        each = np.array([spread.rotation_rad] * 3 + [spread.translation_m] * 3)
        predicted_m = np.linalg.norm(to_motions * each, axis=1)
        predicted = np.diag(each**2)
    corrections_m = to_motions @ np.concatenate(log(inverse(T_world_predicted) @ T_world_found))
    gains = predicted_m**2 / (predicted_m**2 + found_m**2)
    gains[np.abs(corrections_m) > _MOST_SIGMAS * np.hypot(predicted_m, found_m)] = 0.0
    weights = shown + (1.0 - shown) * gains
    kept = motions.T @ (weights * corrections_m)
    unshown_m = (1.0 - shown) * gains * found_m
    gain = motions.T @ np.diag(weights) @ to_motions
    open_m = (1.0 - shown) * np.sqrt(1.0 - gains) * predicted_m
    shown_m = found_m * np.sqrt((1.0 - shown) / np.maximum(shown, _LEAST_SHOWN))
    shown_m = np.minimum(shown_m, fit.degeneracy.extent_m)
    blend = Blend(gain, motions.T @ np.diag(unshown_m**2) @ motions, predicted, open_m, shown_m, unknown_mps)
    return T_world_predicted @ exp(kept[:3], kept[3:]), blend
