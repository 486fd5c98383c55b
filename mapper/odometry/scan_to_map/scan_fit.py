"""Fit of a scan to a keyframe under a motion: overlap, agreement by direction, free space, observability."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Array, Transform, apply
from mapper.core.subsampling import stride_for
from mapper.odometry.scan_to_map.scan_matcher import DeskewedScan
from mapper.odometry.scan_to_map.surface_covariance import surface_covariance
from mapper.registration.acceptance import weakest_direction
from mapper.registration.degeneracy import Degeneracy, degeneracy_of
from mapper.registration.free_space import FreeSpaceCheck, ScanDescription, range_image
from mapper.registration.planes import up_of

_MIN_PAIRS = 20
_SURFACE_VOXELS = 0.33  # a point this near to a surface agrees with it
_ALONG = 3.0
"""Pair distances within which a partner shows whether a point lies on a surface: a ring on the ground is as
far from the keyframe's as the sensor moved, up to two pair distances before the next keyframe."""
_DIRECTION_RAD = 0.0175  # of the range images: one degree
_MARGIN_M = 0.2
_CHECKED_POINTS = 2000
_SPACED_VOXELS, _SPACED_PIXELS = 2.0, 2.0
"""Points farther apart are of no surface: rain, dust and ghosts stand where rays pass, under any pose."""
_VIEW_RAD = 0.175  # ten degrees: larger than the gaps between rings
_AS_LARGE = 0.8  # views of one sensor in other surroundings differ by less
_GRAZING = 0.01  # least sine of the angle between a ray and a surface
_PIXELS = 1.5  # a ray that is compared with a point is off by up to so many
_SMALL_SHARE = 0.03
"""Share of a motion's displacements that goes along normals, below which the pairs that show it are counted.
Streets and rooms have more."""
_OFF_VOXELS = 1.0  # nearer to the keyframe rings lie on the same places, and so errors of normals are alike
_SAME_VOXELS = 0.25  # nearer to it a sensor seems to stand; 0.2 and 0.3 serve as well, 0.15 and 0.4 do not
_LEAST_BREADTH = 7.0
"""Breadth of the surface of a point that shows whether it stands: where rings pass from a road to a rail,
normals lean along the road, wherever the sensor is. 6 and 10 serve as well."""
_LITTLE_WEIGHT, _ENOUGH_WEIGHT, _STANDARD_ERRORS = 1.0, 3.0, 2.0
"""Weight of the pairs that show a motion, less so many standard errors: a bare tunnel has up to 0.4, one with
walls rough by 10 cm 10 to 20, a motorway 3 to 23, a field with a few trees 1.4 to 10."""
_PAIR_VOXELS = 0.6
"""Error of such a pair: a point agrees within 0.33 voxels, a standard deviation of 0.19, and the normals of
ten neighbours err alike. 0.45 and 0.8 serve as well."""
_WEAK_VOXELS = 0.5  # error of a pose in the direction in which less agrees than usual
_LEAST_WEIGHT = 1e-6  # keeps the error of a motion that no pair shows finite


@dataclass(frozen=True, eq=False)
class ScanKeyframe:
    """A scan that became a node.

    Attributes:
        node: Its number.
        deskewed: The scan as taken all at once in the middle of its sweep.
        T_world_middle: (4, 4) pose of the body then.
        T_world_body: (4, 4) pose of the body at the scan's stamp.
        covariance_at_stamp: (6, 6) of that pose relative to the other, in the body's tangent.
    """

    node: int
    deskewed: DeskewedScan
    T_world_middle: Transform
    T_world_body: Transform
    covariance_at_stamp: Array = field(default_factory=lambda: np.zeros((6, 6)))

    @cached_property
    def description(self) -> ScanDescription:
        """Its points and rays for the free-space check."""
        return described(self.deskewed)

    @cached_property
    def directions(self) -> int:
        """Number of directions in which it has returns."""
        return directions_of(self.deskewed)

    @cached_property
    def up(self) -> Array | None:
        """(3,) up of the scan by the planes in it, body frame; None if they leave it open."""
        return up_of(self.deskewed.prepared)

    def view_share(self, directions: int) -> float:
        """Return the share of its view in that of a scan with returns in so many directions, at most 1.

        More of the scan cannot have partners: half of the keyframe's returns were lost, or something stood
        close before the sensor.
        """
        return min(1.0, self.directions / (_AS_LARGE * directions))


@dataclass(frozen=True, eq=False)
class ScanFit:
    """A scan on a keyframe's surfaces. A pair is a point and the keyframe's point nearest to it.

    Attributes:
        overlap: Share of the points with a partner in range.
        rmse_m: Root mean square distance of these pairs.
        agreement: Share that lies on the surfaces, of those that face the direction where the least does; its
            partners may lie farther along them than those of pairs.
        weakest: (3,) that direction, scan's frame.
        contradicting: Share of the points in space that the keyframe's rays passed.
        rows: (M, 6) Jacobian of the pairs' distances from the keyframe's surfaces by the scan's tangent.
        residuals_m: (M,) these distances.
        points: (M, 3) the paired points, scan's frame.
        degeneracy: Of what the normals of both scans show.
        observability: (6,) of the degeneracy's motions: 1 if measured, 0 if not, and between.
        shown_m: (6,) standard deviation of each of these motions where few pairs show it, 0 where many do, as
            its displacement of the points, metres.
        unobservable: Names of the motions that are rather not measured, as in "translation along x".
    """

    overlap: float
    rmse_m: float
    agreement: float
    weakest: Array
    contradicting: float
    rows: Array
    residuals_m: Array
    points: Array
    degeneracy: Degeneracy
    observability: Array
    shown_m: Array
    unobservable: str

    @cached_property
    def surface_covariance(self) -> Array:
        """(6, 6) of the scan's tangent, from its distances to the surfaces."""
        return surface_covariance(self.rows, self.residuals_m, self.points)

    def weak_covariance(self, voxel_m: float) -> Array:
        """Return the (6, 6) covariance of an error in the direction where the least agrees."""
        covariance = np.zeros((6, 6))
        covariance[3:, 3:] = (_WEAK_VOXELS * voxel_m) ** 2 * np.outer(self.weakest, self.weakest)
        return covariance


def directions_of(deskewed: DeskewedScan) -> int:
    """Return the number of directions, of ten degrees, in which a scan has returns."""
    scan = deskewed.scan
    return int(np.isfinite(range_image(scan.points_body, scan.origin_body, _VIEW_RAD)).sum())


def described(deskewed: DeskewedScan) -> ScanDescription:
    """Return the points and rays of a scan for the free-space check."""
    scan = deskewed.scan
    ranges_m = range_image(scan.points_body, scan.origin_body, _DIRECTION_RAD)
    return ScanDescription(np.eye(4), _checked(deskewed), ranges_m, _DIRECTION_RAD, scan.origin_body)


def _checked(deskewed: DeskewedScan) -> Points32:
    """Return the points of surfaces for the free-space check, each where a ray off by some pixels hits.

    Seen at a grazing angle, ground and walls are passed by the neighbouring rays.
    """
    prepared, origin = deskewed.prepared, deskewed.scan.origin_body
    step = stride_for(len(prepared.points), _CHECKED_POINTS)
    rays = prepared.points[::step] - origin
    ranges_m = np.linalg.norm(rays, axis=1)
    apart_m = np.maximum(_SPACED_VOXELS * prepared.voxel_m, _SPACED_PIXELS * _DIRECTION_RAD * ranges_m)
    is_surface = prepared.spacing_m[::step] <= apart_m
    facing = np.abs(np.einsum("ni,ni->n", prepared.normals[::step], rays))
    sine = np.clip(facing / np.maximum(ranges_m, _MARGIN_M), _GRAZING, 1.0)
    turned = _PIXELS * _DIRECTION_RAD * np.sqrt(1.0 - sine**2)
    beyond = turned / np.maximum(sine - turned, _GRAZING)
    hit = origin + rays * (1.0 + beyond[:, None])
    return np.ascontiguousarray(hit[is_surface].astype(np.float32))


def fit_of(
    keyframe: ScanKeyframe,
    deskewed: DeskewedScan,
    T_key_scan: Transform,
    *,
    max_pair_distance_m: float,
    is_velocity_known: bool = True,
) -> ScanFit | None:
    """Return the fit of a scan; None with too few pairs, or without normals.

    The squared cosine of a motion and a fitted normal has the normal's error squared in it, so that even a
    bare tunnel seems to show the motion along it. Errors of the normals of two scans are independent, so the
    product of both scans' cosines (instrumental variables; Fuller 1987, §1.4) has none.

    Where the sensor seems to stand, rings lie on the same places, and so they do on a road that looks alike
    all along: only points whose neighbours lie on a plane show that motion.

    Args:
        keyframe: With the surfaces.
        deskewed: The scan.
        T_key_scan: (4, 4) motion between both in the middle of their sweeps.
        max_pair_distance_m: Largest distance between the points of a pair.
        is_velocity_known: Whether earlier scans showed how the sensor moves. If not, it may seem to stand
            along such a road also where its pose drifts across it, by up to a voxel.
    """
    target, source = keyframe.deskewed.prepared, deskewed.prepared
    points_key = apply(T_key_scan, source.points)
    indices, distances_m = target.nearest(points_key)
    near = np.flatnonzero(distances_m <= max_pair_distance_m)
    if len(near) < _MIN_PAIRS:
        return None
    normals_key = target.normals[indices]
    off_m = np.einsum("ni,ni->n", normals_key, points_key - target.points[indices])
    points, residuals_m = source.points[near], off_m[near]
    normals = normals_key[near] @ T_key_scan[:3, :3]
    own = source.normals[near]
    own = own * np.sign(np.einsum("ni,ni->n", own, normals))[:, None]
    rows = np.hstack([np.cross(points, normals), normals])
    own_rows = np.hstack([np.cross(points, own), own])
    shown, is_counted = _shown(rows, own_rows), np.ones(len(near), np.bool_)
    if np.trace(shown[3:, 3:]) <= 0.0:
        return None
    degeneracy = degeneracy_of(shown, points=source.points, min_share=_SMALL_SHARE)
    moved_voxels = float(np.linalg.norm(T_key_scan[:3, 3])) / source.voxel_m
    if moved_voxels < (_SAME_VOXELS if is_velocity_known else _OFF_VOXELS):
        is_broad = np.minimum(target.breadth[indices[near]], source.breadth[near]) > _LEAST_BREADTH
        of_broad = _shown(rows[is_broad], own_rows[is_broad])
        if np.trace(of_broad[3:, 3:]) > 0.0:
            alone = degeneracy_of(of_broad, points=source.points, min_share=_SMALL_SHARE)
            along_m = np.linalg.norm(alone.directions @ T_key_scan[:3, 3])
            if len(alone.directions) and along_m < _SAME_VOXELS * source.voxel_m:
                shown, is_counted, degeneracy = of_broad, is_broad, alone
    agree = (distances_m <= _ALONG * max_pair_distance_m) & normals_key.any(axis=1)
    agree &= np.abs(off_m) <= _SURFACE_VOXELS * source.voxel_m
    agreement, weakest = weakest_direction(source.normals, agree)
    counts = FreeSpaceCheck(_MARGIN_M).count(keyframe.description, _checked(deskewed), T_key_scan)
    observability, weights = _observability(degeneracy, points, rows, own_rows, agree[near] & is_counted)
    shown_m = _PAIR_VOXELS * source.voxel_m / np.sqrt(weights)
    if moved_voxels < _OFF_VOXELS:
        observability[: degeneracy.unobservable_count] = 0.0
    unobservable = ""
    if observability.min() < 0.5:
        least = 1.001 * float(degeneracy.shares[observability < 0.5].max())
        unobservable = degeneracy_of(shown, points=source.points, min_share=max(least, 1e-9)).text
    return ScanFit(
        overlap=len(near) / len(source.points),
        rmse_m=float(np.sqrt(np.mean(distances_m[near] ** 2))),
        agreement=agreement,
        weakest=weakest,
        contradicting=counts.contradicting_ratio,
        rows=rows,
        residuals_m=residuals_m,
        points=points,
        degeneracy=degeneracy,
        observability=observability,
        shown_m=np.minimum(shown_m, degeneracy.extent_m),
        unobservable=unobservable,
    )


def _shown(rows: Array, own_rows: Array) -> Array:
    """Return the (6, 6) information of products of both scans' rows."""
    products = np.einsum("ni,nj->ij", rows, own_rows)
    information: Array = 0.5 * (products + products.T)
    return information


def _observability(
    degeneracy: Degeneracy, points: Array, rows: Array, own_rows: Array, agree: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return (6,) whether the pairs that agree show a motion (as Tuna et al. 2024, §III, sum contributions).

    With it comes (6,) how much these pairs weigh; infinite where many pairs show the motion. Shares do not
    show it, as noise makes one of every pair. A pair weighs as much as the product of its displacements along
    both normals, of a motion that displaces all points by 1 m root mean square, and at most 1: however many
    pairs lie on one tree, they hardly measure a rotation about it. Rough walls, of which no pair faces the
    motion, show it, too. Noise adds to such a sum no more than a few of its standard errors.
    """
    observability, weights = np.ones(6), np.full(6, np.inf)
    for k in range(degeneracy.unobservable_count):
        motion = degeneracy.motions[k]
        displacements = np.cross(motion[:3], points[agree]) + motion[3:]
        squared = np.einsum("ni,ni->n", displacements, displacements)
        products = (rows[agree] @ motion) * (own_rows[agree] @ motion) / np.maximum(squared, 1.0)
        weight = float(products.sum())
        least = weight - _STANDARD_ERRORS * float(np.sqrt((products**2).sum()))
        observability[k] = np.clip((least - _LITTLE_WEIGHT) / (_ENOUGH_WEIGHT - _LITTLE_WEIGHT), 0.0, 1.0)
        weights[k] = max(weight, _LEAST_WEIGHT)
    return observability, weights


def contradiction(keyframe: ScanKeyframe, description: ScanDescription, T_key_scan: Transform) -> float:
    """Return the share of both scans' points in space that the other's rays passed, the mean of the two."""
    both = FreeSpaceCheck(_MARGIN_M).compare(keyframe.description, description, T_key_scan)
    return 0.5 * (both.source.contradicting_ratio + both.target.contradicting_ratio)
