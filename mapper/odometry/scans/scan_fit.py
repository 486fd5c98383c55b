"""Fit of a scan to a keyframe under a motion: overlap, agreement by direction, free space, observability."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Array, Transform, apply, inverse
from mapper.core.linear import gram
from mapper.odometry.scans.scan_fit_kernels import count_showing, pair_rows
from mapper.odometry.scans.scan_matcher import DeskewedScan
from mapper.registration.acceptance import weakest_direction
from mapper.registration.degeneracy import Degeneracy, degeneracy_of, plane_rows
from mapper.registration.free_space import DIRECTION_RAD, FreeSpaceCheck, ScanDescription, range_image

_MIN_PAIRS = 20
_SURFACE_VOXELS = 0.33  # a point this near to a surface agrees with it
_MARGIN_M = 0.2
_CHECKED_POINTS = 2000
_GRAZING = 0.01  # least sine of the angle between a ray and a surface
_PIXELS = 1.5  # a ray that is compared with a point is off by up to this number
_LEAST_IN_SIGHT = 0.2  # of the points: fewer in sight tell nothing of the others
_AT_EDGES = 5
"""Points of a planar scan that edges put where rays passed: of some hundreds, they would be a share."""
_ON_A_LINE = 3  # a point and its neighbours on both sides
_FACING = 0.3
"""Share of one point's displacement along its normals, from which on its pair shows the motion: more than
the errors of normals make."""
_SAME_VOXELS = 0.25
"""So near the scan seems to stand where the keyframe was taken: in a corridor that is what its rings show of
any motion along it."""
_CHANCE, _CHANCE_NEAR = 0.006, 0.02
"""Share of the pairs that seem to show a motion that nothing shows: of scans a voxel and more apart, and how
much more of those at one place, where rings lie alike and so errors of normals do. Bare tunnels and corridors
have up to 0.0056, and 0.016 at a third of a voxel."""
_CHANCE_PAIRS = 4.0
"""Mean of the pairs above that share in them; a tree in a field has 13."""


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
    def spacing_m(self) -> Array:
        """(N,) distances of its prepared points from their neighbours on a line; 0 of points on none.

        Far and seen at a grazing angle, the points of a planar scan are metres apart.
        """
        prepared = self.deskewed.prepared
        if prepared.tree is None or len(prepared.points) < _ON_A_LINE:
            return np.zeros(len(prepared.points))
        _, distances_m = prepared.tree.nearest_few(prepared.points, _ON_A_LINE)
        return np.asarray(np.where(prepared.normals.any(axis=1), distances_m[:, -1], 0.0), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class ScanFit:
    """A scan on a keyframe's surfaces. A pair is a point and the keyframe's point nearest to it.

    Attributes:
        overlap: Share of the points with a partner in range; of planar scans, of those in sight.
        rmse_m: Root mean square distance of these pairs.
        agreement: Share that lies on the surfaces, of those that face the direction where the least does; of
            planar scans, of those in sight.
        contradicting: Share of the points in space that the keyframe's rays passed.
        rows: (M, 6) Jacobian of the pairs' distances from the keyframe's surfaces by the scan's tangent.
        residuals_m: (M,) these distances.
        points: (M, 3) the paired points, scan's frame.
        degeneracy: Of what the normals of both scans show.
        observability: (6,) of the degeneracy's motions: probability that surfaces show it, not chance.
        unobservable: Names of the motions that are rather not measured, as in "translation along x".
        is_planar: The scans are planar: z and tilt are not measured, but known to be 0.
        paired: (N,) which of the scan's prepared points have a partner in range.
        agreeing: (N,) which of them lie on the surfaces.
    """

    overlap: float
    rmse_m: float
    agreement: float
    contradicting: float
    rows: Array
    residuals_m: Array
    points: Array
    degeneracy: Degeneracy
    observability: Array
    unobservable: str
    is_planar: bool
    paired: NDArray[np.bool_]
    agreeing: NDArray[np.bool_]


def described(deskewed: DeskewedScan) -> ScanDescription:
    """Return the points and rays of a scan for the free-space check."""
    scan = deskewed.scan
    ranges_m = range_image(scan.points_body, scan.origin_body, DIRECTION_RAD)
    return ScanDescription(np.eye(4), _checked(deskewed), ranges_m, DIRECTION_RAD, scan.origin_body)


def _checked(deskewed: DeskewedScan) -> Points32:
    """Return the points for the free-space check, each where a ray off by some pixels hits its surface.

    Seen at a grazing angle, ground and walls are passed by the neighbouring rays.
    """
    prepared, origin = deskewed.prepared, deskewed.scan.origin_body
    step = max(1, -(-len(prepared.points) // _CHECKED_POINTS))
    rays = prepared.points[::step] - origin
    facing = np.abs(np.einsum("ni,ni->n", prepared.normals[::step], rays))
    sine = np.clip(facing / np.maximum(np.linalg.norm(rays, axis=1), _MARGIN_M), _GRAZING, 1.0)
    beyond = _PIXELS * DIRECTION_RAD * np.sqrt(1.0 - sine**2) / sine
    return np.ascontiguousarray((origin + rays * (1.0 + beyond[:, None])).astype(np.float32))


def fit_of(
    keyframe: ScanKeyframe,
    deskewed: DeskewedScan,
    T_key_scan: Transform,
    *,
    max_pair_distance_m: float,
) -> ScanFit | None:
    """Return the fit of a scan; None with too few pairs, or without normals.

    The squared cosine of a motion and a fitted normal has the normal's error squared in it, so that even a
    bare tunnel seems to show the motion along it. Errors of the normals of two scans are independent, so the
    product of both scans' cosines (instrumental variables; Fuller 1987, §1.4) has none. Where both scans seem
    to be taken at one place they are not: to ten neighbours, columns of far points on two opposite walls are
    a plane across the corridor. To the nearest five they are none, so the scan's normals are theirs.

    Args:
        keyframe: With the surfaces.
        deskewed: The scan.
        T_key_scan: (4, 4) motion between both in the middle of their sweeps.
        max_pair_distance_m: Largest distance between the points of a pair.
    """
    target, source = keyframe.deskewed.prepared, deskewed.prepared
    points_key = apply(T_key_scan, source.points)
    indices, distances_m = target.nearest(points_key)
    is_planar = deskewed.scan.is_planar
    reach_m = (
        np.maximum(max_pair_distance_m, keyframe.spacing_m[indices]) if is_planar else max_pair_distance_m
    )
    paired = distances_m <= reach_m
    near = np.flatnonzero(paired)
    if len(near) < _MIN_PAIRS:
        return None
    points = source.points[near]
    moved_voxels = float(np.linalg.norm(T_key_scan[:3, 3])) / source.voxel_m
    elsewhere = min(1.0, moved_voxels / _SAME_VOXELS)
    rows, own_rows, residuals_m = pair_rows(
        near,
        indices,
        source.points,
        points_key,
        source.normals,
        source.normals if elsewhere == 1.0 else source.near_normals(),
        elsewhere,
        target.points,
        target.normals,
        T_key_scan[:3, :3],
    )
    if np.einsum("ni,ni->", rows[:, 3:], own_rows[:, 3:]) <= 0.0:
        return None
    agree = np.zeros(len(source.points), dtype=bool)
    agree[near] = _lie_on(residuals_m, rows[:, 3:], source.voxel_m)
    counting, seen = source.normals, len(source.points)
    if is_planar:
        in_sight = _in_sight(keyframe.description, points_key) | agree
        counting, seen = counting * in_sight[:, None], max(int(in_sight.sum()), int(_LEAST_IN_SIGHT * seen))
    agreement, _ = weakest_direction(counting, agree)
    counts = FreeSpaceCheck(_MARGIN_M).count(keyframe.description, _checked(deskewed), T_key_scan)
    by_surfaces = _Pairs(points, rows, own_rows, agree[near])
    pairs = by_surfaces.in_their_plane() if is_planar else by_surfaces
    information = pairs.information()
    degeneracy = degeneracy_of(information, points=source.points)
    chance = len(near) * (_CHANCE + _CHANCE_NEAR * max(0.0, 1.0 - moved_voxels))
    observability = _observability(degeneracy, pairs, chance_pairs=chance)
    unobservable = ""
    if observability.min() < 0.5:
        least = 1.001 * float(degeneracy.shares[observability < 0.5].max())
        unobservable = degeneracy_of(information, points=source.points, min_share=max(least, 1e-9)).text
    return ScanFit(
        overlap=min(1.0, len(near) / seen),
        rmse_m=float(np.sqrt(np.mean(distances_m[near] ** 2))),
        agreement=agreement,
        contradicting=max(0, counts.contradicting - is_planar * _AT_EDGES) / max(counts.points, 1),
        rows=rows,
        residuals_m=residuals_m,
        points=points,
        degeneracy=degeneracy,
        observability=observability,
        unobservable=unobservable,
        is_planar=is_planar,
        paired=paired,
        agreeing=agree,
    )


def shares_on(
    fit: ScanFit,
    others: Iterable[ScanKeyframe],
    deskewed: DeskewedScan,
    T_world_scan: Transform,
    *,
    max_pair_distance_m: float,
) -> tuple[float, float]:
    """Return overlap and agreement with a keyframe and, where it shows nothing, with other scans.

    One scan shows little of what the next sees of a narrow view, from sparse rings or while it turns; the
    first of several that shows a point's surroundings decides whether it agrees.

    Args:
        fit: To the keyframe, at the same pose.
        others: The other scans.
        deskewed: The scan.
        T_world_scan: (4, 4) its pose in the middle of its sweep.
        max_pair_distance_m: Largest distance between the points of a pair.
    """
    source, paired, agreeing = deskewed.prepared, fit.paired.copy(), fit.agreeing.copy()
    for other in others:
        alone = np.flatnonzero(~paired)
        target = other.deskewed.prepared
        points = apply(inverse(other.T_world_middle) @ T_world_scan, source.points[alone])
        indices, distances_m = target.nearest(points)
        normals = target.normals[indices]
        off_m = np.einsum("ni,ni->n", normals, points - target.points[indices])
        paired[alone] = near = distances_m <= max_pair_distance_m
        agreeing[alone] = near & _lie_on(off_m, normals, source.voxel_m)
    return float(paired.mean()), weakest_direction(source.normals, agreeing)[0]


def _lie_on(off_m: Array, normals: Array, voxel_m: float) -> NDArray[np.bool_]:
    """Return which (N,) points lie on surfaces, by their distances from these and the normals."""
    on_surfaces: NDArray[np.bool_] = (np.abs(off_m) <= _SURFACE_VOXELS * voxel_m) & normals.any(axis=1)
    return on_surfaces


def _in_sight(keyframe: ScanDescription, points_key: Array) -> NDArray[np.bool_]:
    """Return the mask of the points of a planar scan that are not hidden from a keyframe nor beside its view.

    A scanner of 180° that turns sees half of its view anew within a second.
    """
    nearest_m = keyframe.ranges_m.min(axis=0)
    offsets = points_key[:, :2] - keyframe.origin_body[:2]
    columns = ((np.arctan2(offsets[:, 1], offsets[:, 0]) + np.pi) / keyframe.direction_rad).astype(np.intp)
    ray_m = nearest_m[columns % len(nearest_m)]
    in_sight: NDArray[np.bool_] = np.isfinite(ray_m) & (np.hypot(*offsets.T) <= ray_m + _MARGIN_M)
    return in_sight


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Pairs of points: those of the scan, the rows of both scans' normals, and whether they agree."""

    points: Array
    rows: Array
    own_rows: Array
    agree: NDArray[np.bool_]

    def in_their_plane(self) -> "_Pairs":
        """Return the pairs of planar scans with as many that lie on the plane: it shows z and tilt."""
        level = plane_rows(self.points)
        return _Pairs(
            np.vstack([self.points, self.points]),
            np.vstack([self.rows, level]),
            np.vstack([self.own_rows, level]),
            np.concatenate([self.agree, np.ones(len(level), np.bool_)]),
        )

    def information(self) -> Array:
        """Return the (6, 6) information that is in the normals of both scans."""
        shown = gram(self.rows, self.own_rows)
        return np.asarray(0.5 * (shown + shown.T), np.float64)


def _observability(degeneracy: Degeneracy, pairs: _Pairs, *, chance_pairs: float) -> Array:
    """Return (6,) probability that the pairs that show a motion are not there by chance.

    The pairs are counted (as Tuna et al. 2024, §III, count contributions), or, where all of them show a
    little, as on slopes, the squared cosines summed. Shares alone do not tell: normals off by a few degrees,
    a thousand times, make as large a share as one tree.
    """
    showing = count_showing(
        degeneracy.motions, pairs.points, pairs.rows, pairs.own_rows, pairs.agree, _FACING
    )
    observability: Array = 1.0 - np.exp(-np.maximum(showing - chance_pairs, 0.0) / _CHANCE_PAIRS)
    return observability


def contradiction(keyframe: ScanKeyframe, description: ScanDescription, T_key_scan: Transform) -> float:
    """Return the share of both scans' points in space that the other's rays passed, the mean of the two."""
    both = FreeSpaceCheck(_MARGIN_M).compare(keyframe.description, description, T_key_scan)
    return 0.5 * (both.source.contradicting_ratio + both.target.contradicting_ratio)
