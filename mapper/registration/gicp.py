"""Clouds prepared for registration, and the three refiners: ICP, point-to-plane ICP and GICP (small_gicp)."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mapper.errors import DataError
from mapper.frames import Points32
from mapper.geometry import Array, Points, Transform, apply, exp, is_rigid
from mapper.registration.base import Alignment, failed

Refiner = Literal["icp", "plane-icp", "gicp"]

_NEIGHBOURS = 10
_MIN_PAIRS = 20
_VOXELS_ACROSS = 2**20  # small_gicp keeps 21 bits of each voxel coordinate and drops the points beyond
_STEP_VOXELS = 0.003  # steps shorter than this end the refinement: 1 mm at 0.3 m
_STEP_RAD = 3.5e-4
_MIN_SIGMA_VOXELS = 0.03  # a scan against itself must not look infinitely certain
_LIBRARY_NAMES = {"icp": "ICP", "gicp": "GICP"}


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """A downsampled cloud, ready to be either side of any number of registrations.

    Attributes:
        points: (N, 3) centroids of the occupied voxels, metres.
        normals: (N, 3) unit normals; zero where the neighbours are too few to tell.
        voxel_m: Edge of the voxels.
        neighbours: Points that each normal rests on.
        cloud: small_gicp's points with covariances.
        tree: small_gicp's k-d tree of them.
    """

    points: Points
    normals: Array
    voxel_m: float
    neighbours: int
    cloud: Any
    tree: Any

    def nearest(self, points: Points) -> tuple[NDArray[np.intp], Array]:
        """Return which prepared point is nearest to each of (M, 3) points, and how far it is."""
        if len(self.points) == 0 or len(points) == 0:
            return np.zeros(len(points), np.intp), np.full(len(points), np.inf)
        indices, squared = self.tree.batch_knn_search(points, 1)
        return indices[:, 0].astype(np.intp), np.sqrt(squared[:, 0])


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """All points of a cloud, of any size, for distances to it alone."""

    tree: Any

    def distances_m(self, points: Points) -> Array:
        """Return how far each of (M, 3) points is from the nearest of the cloud's."""
        _, squared = self.tree.batch_knn_search(points, 1)
        distances_m: Array = np.sqrt(squared[:, 0])
        return distances_m


def neighbourhood(points: Points32 | Points) -> Neighbourhood:
    """Return a cloud's search tree.

    Raises:
        DataError: The cloud is empty.
    """
    import small_gicp

    if len(points) == 0:
        raise DataError("cloud: no points, so nothing is near it")
    return Neighbourhood(small_gicp.KdTree(points, 1))


def prepared(points: Points32 | Points, *, voxel_m: float, neighbours: int = _NEIGHBOURS) -> Prepared:
    """Return a cloud with one point a voxel, its normals, covariances and search tree.

    One thread: several would downsample in an order that differs from run to run.

    Args:
        points: (N, 3) finite positions, metres.
        voxel_m: Edge of the voxels, metres.
        neighbours: Nearest points that give each normal and covariance.

    Raises:
        DataError: A point lies more than 2²⁰ voxels from the origin.
    """
    import small_gicp

    if len(points) == 0:
        return Prepared(np.empty((0, 3)), np.empty((0, 3)), voxel_m, neighbours, None, None)
    farthest_m, limit_m = float(np.abs(points).max()), _VOXELS_ACROSS * voxel_m
    if farthest_m >= limit_m:
        raise DataError(
            f"cloud: a coordinate of {farthest_m:.0f} m is beyond {limit_m:.0f} m, the most at "
            f"{voxel_m} m voxels; move the cloud to the origin or enlarge voxel_m"
        )
    cloud, tree = small_gicp.preprocess_points(points, voxel_m, neighbours, 1)
    return Prepared(cloud.points()[:, :3], cloud.normals()[:, :3], voxel_m, neighbours, cloud, tree)


def refine(
    target: Prepared,
    source: Prepared,
    T_target_source: Transform,
    *,
    kind: Refiner,
    max_pair_distance_m: float,
    max_iterations: int = 40,
) -> Alignment:
    """Return the motion refined from a guess by the nearest pairs, as ``measured`` with that pair distance.

    It tells no right answer from a wrong one: that is for the caller, who knows what overlap to expect.

    Args:
        target: Cloud that stays; its normals and tree are used.
        source: Cloud that moves.
        T_target_source: (4, 4) guess.
        kind: ``icp`` (Besl & McKay 1992), ``plane-icp`` (Chen & Medioni 1992), ``gicp`` (Segal, Haehnel
            & Thrun 2009). small_gicp's own point-to-plane factor weighs the residual's components one by one
            and not the distance along the normal, so that one is ours.
        max_pair_distance_m: Points without a partner this near take no part.
        max_iterations: At most so many.
    """
    found = refined_motion(
        target,
        source,
        T_target_source,
        kind=kind,
        max_pair_distance_m=max_pair_distance_m,
        max_iterations=max_iterations,
    )
    if isinstance(found, str):
        return failed(found)
    return measured(target, source, found, max_pair_distance_m=max_pair_distance_m)


def refined_motion(
    target: Prepared,
    source: Prepared,
    T_target_source: Transform,
    *,
    kind: Refiner,
    max_pair_distance_m: float,
    max_iterations: int = 40,
) -> Transform | str:
    """Return what ``refine`` does but not what it is worth, or why there is none."""
    import small_gicp

    if min(len(target.points), len(source.points)) < _MIN_PAIRS:
        return (
            f"{len(target.points)} and {len(source.points)} points after downsampling, "
            f"fewer than {_MIN_PAIRS}"
        )
    if kind == "plane-icp":
        T_refined = _plane_icp(
            target,
            source,
            T_target_source,
            max_pair_distance_m=max_pair_distance_m,
            iterations=max_iterations,
        )
    else:
        result = small_gicp.align(
            target.cloud,
            source.cloud,
            target.tree,
            T_target_source,
            registration_type=_LIBRARY_NAMES[kind],
            max_correspondence_distance=max_pair_distance_m,
            num_threads=1,
            max_iterations=max_iterations,
            rotation_epsilon=_STEP_RAD,
            translation_epsilon=_STEP_VOXELS * source.voxel_m,
        )
        T_refined = np.asarray(result.T_target_source)
    return T_refined if is_rigid(T_refined) else f"{kind} diverged"


def measured(
    target: Prepared,
    source: Prepared,
    T_target_source: Transform,
    *,
    max_pair_distance_m: float,
    max_surface_distance_m: float = np.inf,
) -> Alignment:
    """Return what a motion is worth, by whatever method it was found.

    A pair is a source point and the target point nearest to it. The information is that of point-to-plane
    distances, Σ JᵀJ / σ² with J = [(s × m)ᵀ, mᵀ] and m = Rᵀn (the source's tangent, multiplied on the
    right): what the surfaces can fix, by whichever residual the motion was found. (Point-to-point residuals
    would claim to see the motion along a wall.) σ is what the residuals show. Points that share a normal are
    not independent, so as many count once as went into each normal.

    Args:
        target: Cloud that stays.
        source: Cloud that moves.
        T_target_source: (4, 4) motion in question.
        max_pair_distance_m: How near the points of a pair must be to agree.
        max_surface_distance_m: How near the source point must be to the target's surface. Finite, it tells
            wrong motions from right ones better than the distance between points, which is mostly that
            between samples; points with no surface about them then do not agree.
    """
    indices, distances_m = target.nearest(apply(T_target_source, source.points))
    near = distances_m <= max_pair_distance_m
    if near.sum() < _MIN_PAIRS:
        return failed(
            f"{near.sum()} of {len(source.points)} points have a partner within {max_pair_distance_m:g} m, "
            f"fewer than {_MIN_PAIRS}: the clouds do not overlap"
        )
    jacobian, residuals_m = _plane_rows(target, source, T_target_source, indices[near], near)
    known = jacobian.any(axis=1)
    rms_m = float(np.sqrt((residuals_m**2).sum() / max(known.sum(), 1)))
    sigma_m = max(rms_m, _MIN_SIGMA_VOXELS * source.voxel_m)
    agree = np.where(known, np.abs(residuals_m), np.inf) <= max_surface_distance_m
    pairs = int(agree.sum())
    return Alignment(
        T_target_source,
        converged=True,
        inlier_ratio=pairs / len(near),
        inlier_rmse_m=float(np.sqrt((distances_m[near][agree] ** 2).sum() / max(pairs, 1))),
        pairs=pairs,
        information=_gram(jacobian) / (target.neighbours * sigma_m**2),
    )


def _plane_icp(
    target: Prepared,
    source: Prepared,
    T_target_source: Transform,
    max_pair_distance_m: float,
    iterations: int,
) -> Transform:
    """Return Gauss–Newton's answer to the point-to-plane distances (Chen & Medioni 1992)."""
    for _ in range(iterations):
        indices, distances_m = target.nearest(apply(T_target_source, source.points))
        near = distances_m <= max_pair_distance_m
        jacobian, residuals_m = _plane_rows(target, source, T_target_source, indices[near], near)
        damping = 1e-6 * (1.0 + len(residuals_m))  # a direction that no plane sees stays where it was
        step = np.linalg.solve(
            _gram(jacobian) + damping * np.eye(6), -np.einsum("ni,n->i", jacobian, residuals_m)
        )
        T_target_source = T_target_source @ exp(step[:3], step[3:])
        if np.linalg.norm(step[:3]) < _STEP_RAD and np.linalg.norm(step[3:]) < _STEP_VOXELS * source.voxel_m:
            break
    return T_target_source


def _plane_rows(
    target: Prepared,
    source: Prepared,
    T_target_source: Transform,
    partners: NDArray[np.intp],
    paired: NDArray[np.bool_],
) -> tuple[Array, Array]:
    """Return (M, 6) Jacobian rows and (M,) distances along the target's normals; 0 where there is none."""
    normals, points_source = target.normals[partners], source.points[paired]
    differences = apply(T_target_source, points_source) - target.points[partners]
    normals_source = normals @ T_target_source[:3, :3]
    jacobian = np.hstack([np.cross(points_source, normals_source), normals_source])
    return jacobian, np.einsum("ni,ni->n", normals, differences)


def _gram(rows: Array) -> Array:
    """Return rowsᵀ·rows, summed in one order however many threads a BLAS would take."""
    product: Array = np.einsum("ni,nj->ij", rows, rows)
    return product
