"""Check of a camera's focal length against its images: wrong intrinsics stretch every map without a loss."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points
from mapper.odometry.keyframes.bundle_adjustment import adjust, common_parameter

WINDOW_KEYFRAMES = 10
"""Keyframes that are adjusted by themselves: neighbours outside would hold them to the focal length given."""
_MIN_WINDOWS, _MAX_WINDOWS = 4, 16
_MIN_OBSERVERS = 3
_STEPS, _MAX_STEP = 2, 0.1
_ROUNDS, _ITERATIONS = 2, 10
_MIN_ERROR, _MIN_SIGMAS = 0.05, 2.0
"""Relative error, and certainty beyond it, of a doubt. Distortion that is not modelled, a rolling shutter and
makers' nominal values give less: TUM's fr1_xyz at half its size 4.9 %, where the path is right to 8 mm."""
_NO_LINKS = np.empty((0, 2), np.int32), np.empty((0, 4, 4)), np.empty((0, 6, 6))


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """Some keyframes, the landmarks that they share, and their observations.

    Attributes:
        poses: (K, 4, 4) T_camera_world.
        points: (P, 3) metres, world.
        edges: (E, 2) int32 keyframe and point of each observation, grouped by point.
        measured: (E, 3) as for ``adjust``.
        weights: (E, 3) as for ``adjust``.
        intrinsics: (5,) as for ``adjust``.
    """

    poses: Array
    points: Points
    edges: NDArray[np.int32]
    measured: Array
    weights: Array
    intrinsics: Array

    def of_points_seen_by(self, keyframes: int) -> "Bundle":
        """Return the bundle without the points that fewer keyframes observe."""
        observers = np.bincount(self.edges[:, 1], minlength=len(self.points))
        kept = (observers >= keyframes)[self.edges[:, 1]]
        points, rows = np.unique(self.edges[kept, 1], return_inverse=True)
        edges = np.column_stack([self.edges[kept, 0], rows]).astype(np.int32)
        return Bundle(
            self.poses, self.points[points], edges, self.measured[kept], self.weights[kept], self.intrinsics
        )


class FocalLengthCheck:
    """Estimate of the focal length that a log's images and depth fit, relative to the one that is given.

    Rotations shift pixels by the focal length, and translations by its share of the inverse depth, which the
    depth images measure; so it is one more unknown of a bundle adjustment (Triggs et al. 2000, §2.2). Windows
    that share no observation are adjusted with it, and their spread tells how certain their mean is.
    """

    def __init__(self) -> None:
        self._errors: list[float] = []
        self._information: list[float] = []

    @property
    def is_complete(self) -> bool:
        """Whether enough windows were added."""
        return len(self._errors) >= _MAX_WINDOWS

    def add(self, bundle: Bundle) -> None:
        """Add a window of ``WINDOW_KEYFRAMES`` keyframes, the first of which stays where it is."""
        bundle = bundle.of_points_seen_by(_MIN_OBSERVERS)
        if not len(bundle.edges):
            return
        first_edge = np.searchsorted(bundle.edges[:, 1], np.arange(len(bundle.points) + 1)).astype(np.int32)
        free = np.arange(-1, len(bundle.poses) - 1, dtype=np.int32)
        poses, points, intrinsics = bundle.poses, bundle.points, bundle.intrinsics.copy()
        observed = first_edge, bundle.edges, bundle.measured, bundle.weights
        scale = 1.0
        for _ in range(_STEPS):
            poses, points, agree = adjust(
                poses, free, points, *observed, intrinsics, _NO_LINKS, _ROUNDS, _ITERATIONS
            )
            slopes = _focal_slopes(poses, points, bundle.edges, intrinsics)
            information, gradient = common_parameter(
                poses, free, points, *observed, intrinsics, agree, slopes
            )
            if information <= 0.0:
                return
            step = 1.0 + float(np.clip(-gradient / information, -_MAX_STEP, _MAX_STEP))
            scale *= step
            intrinsics[:2] *= step
        self._errors.append(scale - 1.0)
        self._information.append(information)

    def estimate(self) -> tuple[float, float]:
        """Return the relative error of the given focal length and its standard deviation, by all windows."""
        if len(self._errors) < _MIN_WINDOWS:
            return 0.0, math.inf
        errors, information = np.array(self._errors), np.array(self._information)
        mean = float(np.average(errors, weights=information))
        excess = float((information * (errors - mean) ** 2).sum()) / (len(errors) - 1)
        return mean, math.sqrt(max(excess, 1.0) / information.sum())

    def contradiction(self, fx_px: float) -> str:
        """Return in words that the images contradict the focal length; empty if they do not."""
        error, sigma = self.estimate()
        if abs(error) < _MIN_ERROR + _MIN_SIGMAS * sigma:
            return ""
        return (
            f"the images fit a focal length of {fx_px * (1.0 + error):.0f} px, not {fx_px:.0f} px "
            f"({100.0 * error:+.1f} ± {100.0 * sigma:.1f} %): check source.camera.fx_px and fy_px, or the "
            "log's calibration; distances across the view are wrong by as much"
        )


def _focal_slopes(poses: Array, points: Points, edges: NDArray[np.int32], intrinsics: Array) -> Array:
    """Return the (E, 2) change of the residuals of u and v with the focal length's relative change."""
    T, points = poses[edges[:, 0]], points[edges[:, 1]]
    x, y, z = (np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]).T
    z = np.maximum(z, 1e-3)
    return -np.column_stack([intrinsics[0] * x / z, intrinsics[1] * y / z])
