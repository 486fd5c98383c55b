"""Alignment of a depth image to those of keyframes, together with the landmarks of the frame, if any.

Each point is compared with the plane of the keyframe's cell that it projects to (Chen & Medioni 1992;
Blais & Levine 1995). Planes and landmarks are weighted by their noise and minimised at once, so that a motion
that one of them does not observe is determined by the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import mean
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform, is_rigid
from mapper.odometry.base import Diagnostics
from mapper.odometry.local_map.depth.depth_kernels import (
    Landmarks,
    PlaneModel,
    PosePrior,
    bent_by_distortion,
    compare,
    descend,
    seen_through,
)
from mapper.odometry.local_map.observation.depth_surfaces import (
    DepthCells,
    DepthSurface,
    point_sigmas,
    surface_of,
)
from mapper.registration.degeneracy import Degeneracy, degeneracy_of, projected
from mapper.registration.reprojection import normal_matrix
from mapper.sensing.config import KINECT_NOISE, DepthNoiseConfig

_MIN_POINTS = 300
_MIN_SHARE, _NOISE_SHARES = 0.004, 2.5
"""A motion is observed by a larger share of its displacements along the normals: a plane's bow in a Kinect's
depth image gives 0.002, and the normals' noise gives their variance."""
_FEW = 0.02  # of all surface; a direction that less faces is left to the degeneracy check
_LEAST_SCALE = 0.5  # of the assumed noise, however well the surfaces fit
_UNSEEN_PER_M = 0.0004
"""Distortion of inverse depth that no plane shows, each of its three parts (root mean square): half of the
largest that passes for none, added to as much as was measured. Simulated sensors have 0.4 of that, at most
0.9."""
_LINKS_ALIKE = 2.0
"""Links of four keyframes in a row have the same error, while the graph takes them as independent."""
_LEAST_OBSERVED = 1e-4
"""Eigenvalue of the surfaces' information, relative to the largest, below which a motion does not follow."""
_OBSERVED_SIGMA_M = 0.05
"""A motion that landmarks determine this well, as a displacement of the points, is observed by them."""


DEPTH_ONLY = "depth"
"""``TrackedPose.method`` of a pose without landmarks."""


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceSurfaces:
    """Surfaces of earlier depth images of one camera, which another one is aligned to.

    Attributes:
        surfaces: Those of at least one keyframe, and then of other frames.
        T_surfaces_world: (4, 4) T_camera_world of each.
        keyframes: Number of keyframes.
    """

    surfaces: Sequence[DepthSurface]
    T_surfaces_world: Sequence[Transform]
    keyframes: int


@dataclass(frozen=True, slots=True, eq=False)
class DepthAlignment:
    """Pose of a depth image relative to the surfaces of keyframes.

    Attributes:
        T_camera_world: (4, 4).
        information: (6, 6) of the camera's tangent (rotation, translation), from planes and the prediction.
        systematic: (6, 6) covariance by distortion of depth that planes do not show: the next frames have the
            same error.
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
    systematic: Array
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

    @property
    def lasting_information(self) -> Array:
        """(6, 6) information with the distortion, which frames of one place have in common."""
        return np.asarray(np.linalg.inv(np.linalg.inv(self.information) + self.systematic), np.float64)

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
    reference: ReferenceSurfaces,
    *,
    T_camera_world: Transform,
    prior: PosePrior,
    landmarks: Landmarks,
    noise: DepthNoiseConfig | None,
) -> DepthAlignment | None:
    """Return the pose of a depth image that fits surfaces, landmarks and, where neither helps, a prediction.

    Motions that the surfaces do not observe are found first, and are then left to the landmarks and to the
    prediction (Zhang, Kaess & Singh 2016, "solution remapping"): the surfaces' noise must not determine them.

    Args:
        cells: The depth image.
        points: (N, 3) of those points of it that are at rest, camera frame.
        reference: Surfaces of keyframes.
        T_camera_world: (4, 4) to begin with.
        prior: Prediction.
        landmarks: The frame's, if any.
        noise: Depth noise of the sensor; None is a Kinect's.

    Returns:
        The pose, whether it is right or not; None where too few points have a partner.
    """
    if len(points) < _MIN_POINTS:
        return None
    model = PlaneModel(
        points,
        point_sigmas(cells, points, noise),
        np.array([surface.planes for surface in reference.surfaces]),
        np.array(reference.T_surfaces_world),
        cells.camera.parameters,
        cells.cell_px,
    )
    minimum = _minimum(model, landmarks, prior, T_camera_world, _min_share(reference.surfaces))
    if minimum is None:
        return None
    fit, keyframes = minimum.fit, reference.keyframes
    pairs, seen = int(fit.agreeing.sum()), int((fit.verdict != 0).sum())
    scale = max(fit.squares / pairs, _LEAST_SCALE**2)
    plane_counts = np.maximum((model.planes[..., 3] > 0.0).sum(axis=(1, 2)), 1)
    known = _known_by(landmarks, minimum.is_landmark_inlier, minimum.T_camera_world)
    information = projected(fit.information / scale, minimum.degeneracy)
    nearest = int(fit.agreeing[:keyframes].argmax())
    seen_through_ratio = _seen_through_ratio(minimum.T_camera_world, cells, model, noise or KINECT_NOISE)
    return DepthAlignment(
        T_camera_world=minimum.T_camera_world,
        information=information + prior.information,
        systematic=_systematic(
            model, nearest, minimum.T_camera_world, cells, information, known + prior.information
        ),
        is_landmark_inlier=minimum.is_landmark_inlier,
        points=seen,
        agreeing=fit.agreeing[:keyframes],
        overlap=float((fit.agreeing / plane_counts)[:keyframes].max()),
        agreeing_ratio=float((fit.verdict == 1).sum()) / seen,
        weakest_ratio=_weakest(fit.facing, fit.facing_agreeing),
        contradicting_ratio=max(float((fit.verdict == -1).sum()) / seen, seen_through_ratio),
        visible_ratio=seen / len(points),
        rmse_m=float(np.sqrt(fit.squares_m / pairs)),
        unobservable=_unobserved(minimum.degeneracy, known),
        observes_next=minimum.degeneracy.unobservable_count == 0 or observes_all(surface_of(cells)),
    )


class _PlaneFit(NamedTuple):
    """Result of ``compare``."""

    verdict: NDArray[np.int8]
    agreeing: NDArray[np.int64]
    unit_information: Array
    information: Array
    facing: Array
    facing_agreeing: Array
    squares: float
    squares_m: float


class _Minimum(NamedTuple):
    """Pose of least squares, its landmarks and planes, and the motions that planes do not observe."""

    T_camera_world: Transform
    is_landmark_inlier: NDArray[np.bool_]
    fit: _PlaneFit
    degeneracy: Degeneracy


def _minimum(
    model: PlaneModel, landmarks: Landmarks, prior: PosePrior, T_camera_world: Transform, min_share: float
) -> _Minimum | None:
    """Return the minimum; None where too few points have a partner.

    Where planes do not observe a motion, it is found once more, and planes have no part in that motion then.
    """
    kept = np.eye(6)
    while True:
        T_found, is_inlier = descend(T_camera_world, model, landmarks, prior, kept)
        if not is_rigid(T_found):
            return None
        fit = _PlaneFit(*compare(T_found, model))
        agrees = fit.verdict == 1
        if agrees.sum() < _MIN_POINTS:
            return None
        degeneracy = degeneracy_of(fit.unit_information, points=model.points[agrees], min_share=min_share)
        if degeneracy.unobservable_count == 0 or kept.trace() < 6.0:
            return _Minimum(T_found, is_inlier, fit, degeneracy)
        kept = _observable(degeneracy)


def _systematic(
    model: PlaneModel,
    nearest: int,
    T_camera_world: Transform,
    cells: DepthCells,
    information: Array,
    others: Array,
) -> Array:
    """Return the (6, 6) covariance of a pose by distortion that turns planes into other planes.

    A distortion that is affine in the ray moves the surfaces of both images, and the pose follows by as much
    as the surfaces' part of the information allows (Schmidt 1966: a parameter that is not estimated).

    Args:
        model: The alignment.
        nearest: Which of its surfaces the pose is relative to.
        T_camera_world: (4, 4) the pose.
        cells: The depth image.
        information: (6, 6) by the surfaces.
        others: (6, 6) of all else that determines the pose.
    """
    H, B = bent_by_distortion(T_camera_world, model, nearest, cells.rays)
    share = information @ np.linalg.pinv(information + others)
    moved: Array = np.linalg.pinv(H, rcond=_LEAST_OBSERVED) @ B
    spread = np.append(cells.rays.reshape(-1, 2).std(axis=0), 1.0)
    sigma = (_UNSEEN_PER_M + cells.distortion_per_m) / spread
    moved = share.T @ (moved * (_LINKS_ALIKE * sigma))
    return moved @ moved.T


def _seen_through_ratio(
    T_camera_world: Transform, cells: DepthCells, model: PlaneModel, noise: DepthNoiseConfig
) -> float:
    """Return the share of the keyframes' planes that the depth image sees through."""
    through, seen = seen_through(
        T_camera_world,
        cells.inverse_depth,
        model,
        cells.rays,
        np.array([noise.constant_m, noise.linear, noise.quadratic_per_m]),
    )
    return float(through / max(seen, 1))


def _known_by(landmarks: Landmarks, is_inlier: NDArray[np.bool_], T_camera_world: Transform) -> Array:
    """Return the (6, 6) information of landmarks that agree, halved: they were measured no better."""
    known: Array = 0.5 * normal_matrix(
        T_camera_world,
        landmarks.positions[is_inlier],
        landmarks.measured[is_inlier],
        landmarks.weights[is_inlier],
        landmarks.intrinsics,
    )
    return known


def observes_all(surface: DepthSurface) -> bool:
    """Return whether a depth image alone observes every motion of its camera."""
    points, normals = surface.cells.points(), surface.normals()
    fitted = normals.any(axis=1)
    if fitted.sum() < _MIN_POINTS:
        return False
    points, normals = points[fitted], normals[fitted]
    rows = np.hstack([np.cross(points, normals), normals])
    information = np.einsum("ni,nj->ij", rows, rows)
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
