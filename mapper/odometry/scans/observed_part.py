"""Pose of which each motion is measured where surfaces show it, and predicted where they do not."""

import numpy as np

from mapper.core.geometry import Array, Transform, exp, inverse, log
from mapper.odometry.scans.motion_model import Spread
from mapper.odometry.scans.scan_fit import ScanFit

_UNSHOWN_VOXELS = 0.5  # error of a measured motion that next to no surface shows
_MOST_SIGMAS = 3.0
_UNKNOWN_PARTS = 0.1  # share of the extent by which a prediction is off before any could be compared


def observed_part(
    fit: ScanFit,
    T_world_predicted: Transform,
    T_world_found: Transform,
    spread: Spread | None,
    *,
    voxel_m: float,
) -> tuple[Transform, Array]:
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
    gains = predicted_m**2 / (predicted_m**2 + found_m**2)
    gains[np.abs(corrections_m) > _MOST_SIGMAS * np.hypot(predicted_m, found_m)] = 0.0
    weights = shown + (1.0 - shown) * gains
    kept = motions.T @ (weights * corrections_m)
    open_m = (1.0 - shown) * np.sqrt(1.0 - gains) * predicted_m
    return T_world_predicted @ exp(kept[:3], kept[3:]), open_m
