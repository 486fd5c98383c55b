"""Refinement of a motion by nearest pairs, by ICP, plane ICP or GICP, and its assessment."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform, apply, is_rigid
from mapper.core.linear import gram
from mapper.registration.base import Alignment, failed
from mapper.registration.gauss_newton import GAUSSIAN, PLANE, POINT, descend_on_points
from mapper.registration.surfaces import Prepared

Refiner = Literal["icp", "plane-icp", "gicp"]

MIN_PAIRS = 20
_STEP_VOXELS = 0.003  # steps shorter than this end the refinement: 1 mm at 0.3 m
_STEP_RAD = 3.5e-4
_MIN_SIGMA_VOXELS = 0.03  # a scan against itself must not be infinitely certain
_DISTANCES: Mapping[Refiner, int] = {"icp": POINT, "plane-icp": PLANE, "gicp": GAUSSIAN}


def refine(
    target: Prepared,
    source: Prepared,
    T_target_source: Transform,
    *,
    kind: Refiner,
    pair_distances_m: Sequence[float],
    max_iterations: int = 40,
) -> Alignment:
    """Return the motion refined from a guess by the nearest pairs, as ``measured`` at the last pair distance.

    Converged does not mean right: the caller has to compare the inliers with the overlap that it expects.

    Args:
        target: Cloud that stays; its normals and tree are used.
        source: Cloud that moves.
        T_target_source: (4, 4) guess.
        kind: ``icp`` (Besl & McKay 1992), ``plane-icp`` (Chen & Medioni 1992), ``gicp`` (Segal, Haehnel
            & Thrun 2009).
        pair_distances_m: Largest distance between the points of a pair, from coarse to fine.
        max_iterations: Largest number of steps at each of these distances.
    """
    for distance_m in pair_distances_m:
        found = _descended(target, source, T_target_source, kind, distance_m, max_iterations)
        if isinstance(found, str):
            return failed(found)
        alignment = measured(target, source, found, max_pair_distance_m=distance_m)
        if not alignment.converged:
            break
        T_target_source = found
    return alignment


def refined_motion(
    target: Prepared,
    source: Prepared,
    T_target_source: Transform,
    *,
    kind: Refiner,
    pair_distances_m: Sequence[float],
    max_iterations: int = 40,
    max_points: int | None = None,
) -> Transform | str:
    """Return the motion of ``refine`` without its assessment, or why there is none; arguments as there.

    With ``max_points`` fewer than twice as many of the source's points are used, at equal steps.
    """
    step = 1 if max_points is None else max(1, len(source.points) // max_points)
    for distance_m in pair_distances_m:
        found = _descended(target, source, T_target_source, kind, distance_m, max_iterations, step)
        if isinstance(found, str):
            return found
        T_target_source = found
    return T_target_source


def _descended(
    target: Prepared,
    source: Prepared,
    T: Transform,
    kind: Refiner,
    distance_m: float,
    max_iterations: int,
    step: int = 1,
) -> Transform | str:
    if min(len(target.points), len(source.points)) < MIN_PAIRS or target.tree is None:
        return (
            f"{len(target.points)} and {len(source.points)} points after downsampling, fewer than {MIN_PAIRS}"
        )
    T_refined: Transform = descend_on_points(
        target.tree.points,
        target.tree.axes,
        target.tree.cuts,
        target.normals,
        np.ascontiguousarray(source.points[::step]),
        np.ascontiguousarray(source.normals[::step]),
        T,
        _DISTANCES[kind],
        distance_m,
        max_iterations,
        np.array([_STEP_RAD, _STEP_VOXELS * source.voxel_m]),
    )
    return T_refined if is_rigid(T_refined) else f"{kind} diverged"


def measured(
    target: Prepared, source: Prepared, T_target_source: Transform, *, max_pair_distance_m: float
) -> Alignment:
    """Return ``measured_agreement`` without a limit of the distance from surfaces, and without the mask."""
    limits = {"max_pair_distance_m": max_pair_distance_m, "max_surface_distance_m": np.inf}
    return measured_agreement(target, source, T_target_source, **limits)[0]


def measured_agreement(
    target: Prepared,
    source: Prepared,
    T_target_source: Transform,
    *,
    max_pair_distance_m: float,
    max_surface_distance_m: float,
) -> tuple[Alignment, NDArray[np.bool_]]:
    """Return a motion with its assessment, by whatever method it was found, and (N,) which points agree.

    A pair is a source point and the target point nearest to it. The information is that of point-to-plane
    distances, Σ JᵀJ / σ² with J = [(s × m)ᵀ, mᵀ] and m = Rᵀn (the source's tangent, multiplied on the
    right): what the surfaces can fix, whichever residual was minimised. (Point-to-point residuals would make
    the motion along a wall observable.) σ is that of the residuals. Points that share a normal are not
    independent, so as many count once as went into each normal.

    Args:
        target: Cloud that stays.
        source: Cloud that moves.
        T_target_source: (4, 4) motion in question.
        max_pair_distance_m: Largest distance between the points of a pair that agrees.
        max_surface_distance_m: Largest distance of the source point from the target's surface. Finite, it
            separates wrong motions from right ones better than the distance between points, which is mostly
            that between samples; points with no surface about them then do not agree.
    """
    indices, distances_m = target.nearest(apply(T_target_source, source.points))
    near = distances_m <= max_pair_distance_m
    if near.sum() < MIN_PAIRS:
        reason = (
            f"{near.sum()} of {len(source.points)} points have a partner within {max_pair_distance_m:g} m, "
            f"fewer than {MIN_PAIRS}: the clouds do not overlap"
        )
        return failed(reason), np.zeros(len(near), np.bool_)
    jacobian, residuals_m = plane_rows(target, source.points[near], T_target_source, indices[near])
    has_normal = jacobian.any(axis=1)
    rms_m = float(np.sqrt((residuals_m**2).sum() / max(has_normal.sum(), 1)))
    sigma_m = max(rms_m, _MIN_SIGMA_VOXELS * source.voxel_m)
    agree = np.where(has_normal, np.abs(residuals_m), np.inf) <= max_surface_distance_m
    pairs = int(agree.sum())
    alignment = Alignment(
        T_target_source,
        converged=True,
        inlier_ratio=pairs / len(near),
        inlier_rmse_m=float(np.sqrt((distances_m[near][agree] ** 2).sum() / max(pairs, 1))),
        pairs=pairs,
        information=gram(jacobian, jacobian) / (target.neighbours * sigma_m**2),
    )
    near[near] = agree
    return alignment, near


def plane_rows(
    target: Prepared, points_source: Points, T_target_source: Transform, partners: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Return the (M, 6) Jacobian of (M,) distances along the target's normals, and these, in metres.

    Both are 0 where there is no normal. The Jacobian is by the source's tangent: T ← T · exp(δ).

    Args:
        target: Cloud that stays.
        points_source: (M, 3) points of the cloud that moves.
        T_target_source: (4, 4) motion in question.
        partners: (M,) their partners in the target.
    """
    normals = target.normals[partners]
    differences = apply(T_target_source, points_source) - target.points[partners]
    normals_source = normals @ T_target_source[:3, :3]
    jacobian = np.hstack([np.cross(points_source, normals_source), normals_source])
    return jacobian, np.einsum("ni,ni->n", normals, differences)
