"""Alignment of a depth image to those of keyframes, together with the landmarks of the frame, if any.

Each point is held against the plane of the keyframe's cell that it projects to (Chen & Medioni 1992;
Blais & Levine 1995). Planes and landmarks are weighted by their noise and minimised at once, so that a motion
that one of them does not observe is decided by the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import mean

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform, is_rigid
from mapper.core.linear import gram
from mapper.odometry.base import Diagnostics
from mapper.odometry.camera.depth_surfaces import (
    DepthCells,
    DepthSurface,
    point_sigmas,
    surface_of,
)
from mapper.odometry.keyframes.depth_kernels import compare, descend, seen_through
from mapper.registration.degeneracy import Degeneracy, degeneracy_of, projected
from mapper.registration.reprojection import normal_matrix
from mapper.sensing.config import KINECT_NOISE, DepthNoiseConfig

_GATES_M = (0.3, 0.1, 0.04)
_EVERY = (4, 4, 1)
"""One point in this number is used with each of these gates."""
_ITERATIONS = 8
_MIN_POINTS = 300
_MIN_SHARE, _NOISE_SHARES = 0.004, 2.5
"""A motion is observed by a larger share of its displacements along the normals: a plane's bow in a Kinect's
depth image gives 0.002, and the normals' noise gives their variance."""
_FEW = 0.02  # of all surface; a direction that less faces is left to the degeneracy check
_LEAST_SCALE = 0.5  # of the assumed noise, however well the surfaces fit
_OBSERVED_SIGMA_M = 0.05
"""A motion that landmarks know this well, as a displacement of the points, is observed by them."""


DEPTH_ONLY = "depth"
"""``TrackedPose.method`` of a pose without landmarks."""


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Landmarks that a frame's features were matched to.

    Attributes:
        positions: (L, 3) metres, world.
        measured: (L, 3) u, v, bf / z in pixels.
        weights: (L, 3) inverse variances of these, px⁻².
        intrinsics: (5,) fx, fy, cx, cy, bf.
    """

    positions: Points
    measured: Array
    weights: Array
    intrinsics: Array


@dataclass(frozen=True, slots=True, eq=False)
class DepthAlignment:
    """Pose of a depth image relative to the surfaces of keyframes.

    Attributes:
        T_camera_world: (4, 4).
        information: (6, 6) of the camera's tangent (rotation, translation), from planes and the prediction.
        is_landmark_inlier: (L,) which landmarks agree with the pose.
        points: Number of points of the depth image that lie on surfaces of the keyframes, or in front.
        agreeing: (K,) how many of them agree with each keyframe.
        overlap: Number of points that agree with a keyframe relative to its planes, of that with most.
        agreeing_ratio: Share of the points that agree with any.
        weakest_ratio: Share that agrees among the surfaces of that main direction in which the least do.
        contradicting_ratio: Share that stands where keyframes see through, or of their surfaces where the
            depth image sees through, whichever is more.
        visible_ratio: Share of the points that are on or in front of surfaces, not hidden or new.
        rmse_m: Root mean square distance of agreeing points from their planes.
        unobservable: Names of the motions that neither surfaces nor landmarks observe; empty if none.
        observes_next: The depth image alone would observe every motion of a frame that is aligned to it.
    """

    T_camera_world: Transform
    information: Array
    is_landmark_inlier: NDArray[np.bool_]
    points: int
    agreeing: NDArray[np.int64]
    overlap: float
    agreeing_ratio: float
    weakest_ratio: float
    contradicting_ratio: float
    visible_ratio: float
    rmse_m: float
    unobservable: str
    observes_next: bool

    def diagnostics(self, image: Diagnostics) -> Diagnostics:
        """Return the figures on a frame's tracking; those of its image only if landmarks took part."""
        if image.method != DEPTH_ONLY:
            return replace(image, unobservable=self.unobservable)
        return Diagnostics(
            features=image.features,
            matches=self.points,
            inliers=round(self.agreeing_ratio * self.points),
            residual=self.rmse_m,
            residual_unit="m",
            method=image.method,
            unobservable=self.unobservable,
        )


def align_depth(
    cells: DepthCells,
    points: Points,
    surfaces: Sequence[DepthSurface],
    T_surfaces_world: Sequence[Transform],
    *,
    keyframes: int,
    T_camera_world: Transform,
    T_prior: Transform,
    prior: Array,
    landmarks: Landmarks,
    noise: DepthNoiseConfig | None,
) -> DepthAlignment | None:
    """Return the pose of a depth image that fits surfaces, landmarks and, where neither helps, a prediction.

    Motions that the surfaces do not observe are found first, and are then left to the landmarks and to the
    prediction (Zhang, Kaess & Singh 2016, "solution remapping"): the surfaces' noise must not decide them.

    Args:
        cells: The depth image.
        points: (N, 3) of those points of it that stand still, camera frame.
        surfaces: Those of at least one keyframe and of other frames, of the same camera.
        T_surfaces_world: (4, 4) of each.
        keyframes: Number of keyframes, which are the first of them.
        T_camera_world: (4, 4) to begin with.
        T_prior: (4, 4) predicted T_camera_world.
        prior: (6, 6) information of the prediction, camera tangent.
        landmarks: The frame's, if any.
        noise: Depth noise of the sensor; None is a Kinect's.

    Returns:
        The pose, whether it is right or not; None where too few points have a partner.
    """
    if len(points) < _MIN_POINTS:
        return None
    sigmas = point_sigmas(cells, points, noise)
    camera = cells.camera
    optics = np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *camera.distortion])
    planes = np.array([surface.planes for surface in surfaces])
    model = planes, np.array(T_surfaces_world), optics, cells.cell_px
    min_share = _min_share(surfaces)
    kept = np.eye(6)
    while True:
        T_found, is_inlier = descend(
            T_camera_world,
            T_prior,
            prior,
            points,
            sigmas,
            *model,
            kept,
            np.array(_GATES_M),
            np.array(_EVERY),
            _ITERATIONS,
            landmarks.positions,
            landmarks.measured,
            landmarks.weights,
            landmarks.intrinsics,
        )
        if not is_rigid(T_found):
            return None
        verdict, agreeing, unit, information, facing, facing_agreeing, squares, squares_m = compare(
            T_found, points, sigmas, *model
        )
        if (verdict == 1).sum() < _MIN_POINTS:
            return None
        degeneracy = degeneracy_of(unit, points=points[verdict == 1], min_share=min_share)
        if degeneracy.unobservable_count == 0 or kept.trace() < 6.0:
            break
        kept = _observable(degeneracy)
    pairs = int(agreeing.sum())
    scale = max(squares / pairs, _LEAST_SCALE**2)
    seen = int((verdict != 0).sum())
    sigma_m = noise or KINECT_NOISE
    through, seen_back = seen_through(
        T_found,
        cells.inverse_depth,
        planes,
        cells.rays,
        *model[1:],
        np.array([sigma_m.constant_m, sigma_m.linear, sigma_m.quadratic_per_m]),
    )
    known = 0.5 * normal_matrix(
        T_found,
        landmarks.positions[is_inlier],
        landmarks.measured[is_inlier],
        landmarks.weights[is_inlier],
        landmarks.intrinsics,
    )
    return DepthAlignment(
        T_found,
        projected(information / scale, degeneracy) + prior,
        is_inlier,
        seen,
        agreeing[:keyframes],
        float((agreeing / np.maximum((planes[..., 3] > 0.0).sum(axis=(1, 2)), 1))[:keyframes].max()),
        float((verdict == 1).sum()) / seen,
        _weakest(facing, facing_agreeing),
        max(float((verdict == -1).sum()) / seen, through / max(seen_back, 1)),
        seen / len(points),
        float(np.sqrt(squares_m / pairs)),
        _unobserved(degeneracy, known),
        observes_all(surface_of(cells)) if degeneracy.unobservable_count else True,
    )


def observes_all(surface: DepthSurface) -> bool:
    """Return whether a depth image alone observes every motion of its camera."""
    points, normals = surface.cells.points(), surface.normals()
    fitted = normals.any(axis=1)
    if fitted.sum() < _MIN_POINTS:
        return False
    points, normals = points[fitted], normals[fitted]
    rows = np.hstack([np.cross(points, normals), normals])
    information = gram(rows, rows)
    return degeneracy_of(information, points=points, min_share=_min_share([surface])).unobservable_count == 0


def _min_share(surfaces: Sequence[DepthSurface]) -> float:
    return max(_MIN_SHARE, _NOISE_SHARES * mean(surface.normal_variance for surface in surfaces))


def _observable(degeneracy: Degeneracy) -> Array:
    """Return the (6, 6) projection of tangents to the motions that are observable."""
    motions = degeneracy.motions.T
    observable = np.arange(6) >= degeneracy.unobservable_count
    kept: Array = (motions * observable) @ np.linalg.inv(motions)
    return kept


def _weakest(facing: Array, agreeing: Array) -> float:
    """Return the share of surfaces that agrees, in the main direction of the normals where the least do."""
    shares, directions = np.linalg.eigh(facing)
    agree = np.einsum("ik,ij,jk->k", directions, agreeing, directions) / np.maximum(shares, 1e-9)
    return float(np.where(shares >= _FEW * shares.sum(), agree, np.inf).min())


def _unobserved(degeneracy: Degeneracy, known: Array) -> str:
    """Return the names of unobservable motions, unless the information of landmarks observes them all."""
    if degeneracy.unobservable_count == 0:
        return ""
    motions = degeneracy.motions[: degeneracy.unobservable_count]
    least = float(np.linalg.eigvalsh(motions @ known @ motions.T)[0])
    return "" if least >= _OBSERVED_SIGMA_M**-2 else degeneracy.text
