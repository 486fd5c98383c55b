"""Acceptance of a motion found between two scans, by the surfaces that agree with it."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform
from mapper.core.linear import gram
from mapper.registration.base import Alignment
from mapper.registration.config import AcceptanceConfig
from mapper.registration.degeneracy import degeneracy_of
from mapper.registration.pair_refinement import measured_agreement
from mapper.registration.surfaces import Prepared

_FEW = 0.01  # of all surface; a direction that fewer face is left to the degeneracy check


def assess(
    target: Prepared, source: Prepared, T_target_source: Transform, config: AcceptanceConfig
) -> Alignment:
    """Return a motion, assessed; not converged when surfaces contradict it or leave it degenerate.

    Most of a scan is ground, and any ground agrees with any other: under a wrong motion up to 95 % of the
    points can lie on a dense map. So the share of agreeing points is taken in each of the three main
    directions of the normals, a point counting by its normal's squared cosine, and the least of the three is
    compared.

    Args:
        target: Cloud that stays.
        source: Cloud that moves; the one with the smaller view, all of which the other should contain.
        T_target_source: (4, 4) motion in question.
        config: Thresholds, in voxels of the source.
    """
    near_m, surface_m = config.near_voxels * source.voxel_m, config.surface_voxels * source.voxel_m
    alignment, agree = measured_agreement(
        target, source, T_target_source, max_pair_distance_m=near_m, max_surface_distance_m=surface_m
    )
    if not alignment.converged:
        return alignment
    share, direction = weakest_direction(source.normals, agree)
    if share < config.min_agreeing_ratio:
        reason = (
            f"{share:.0%} of the source's surfaces that face ({', '.join(f'{x:.2f}' for x in direction)}) "
            f"lie on the target's, less than {config.min_agreeing_ratio:.0%}"
        )
        return replace(alignment, converged=False, reason=reason)
    assert alignment.information is not None  # it converged
    degeneracy = degeneracy_of(alignment.information, points=source.points)
    return replace(alignment, converged=not degeneracy.reason, reason=degeneracy.reason)


def weakest_direction(normals: Array, agree: NDArray[np.bool_]) -> tuple[float, Array]:
    """Return the share that agrees in the direction where the least does, and that direction."""
    squares, agreeing = gram(normals, normals), normals[agree]
    facing, directions = np.linalg.eigh(squares / max(np.trace(squares), 1.0))
    weights = np.einsum("ik,ij,jk->k", directions, squares, directions)
    shares = np.einsum("ik,ij,jk->k", directions, gram(agreeing, agreeing), directions)
    shares /= np.maximum(weights, np.finfo(float).tiny)
    weakest = int(np.argmin(np.where(facing >= _FEW, shares, np.inf)))
    direction = directions[:, weakest]
    return float(shares[weakest]), direction * np.sign(direction[np.argmax(np.abs(direction))])
