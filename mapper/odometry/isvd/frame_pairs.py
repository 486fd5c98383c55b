"""Registration of two RGB-D frames by ISVD: matching, the motion of the points, then that of the pixels."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import PinholeCamera
from mapper.core.geometry import Array, Points, Transform, adjoint, apply, inverse
from mapper.features.base import Features
from mapper.features.matching import Pairs, homography_inliers, match_mutual
from mapper.odometry.config import MatchConfig
from mapper.registration.base import Alignment, failed
from mapper.registration.config import IsvdConfig
from mapper.registration.isvd import Isvd
from mapper.registration.reprojection import classify, normal_matrix, refine_pose, variance_factor
from mapper.runtime.archived import Archivable

_ROUNDS, _ITERATIONS = 3, 10
_MIN_FREEDOM_PAIRS = 6


@dataclass(frozen=True, slots=True, eq=False)
class IsvdObservation(Archivable):
    """A frame's features with their 3D points.

    Attributes:
        stamp_ns: The frame's stamp.
        features: Features of the image.
        points_body: (N, 3) metres, body frame; NaN where the depth image has no measurement.
        measured: (N, 3) undistorted column and row, and virtual disparity, in pixels; NaN in the third
            column without depth.
        weights: (N, 3) inverse variances of the three, px⁻², by the noise of features and of depth.
        intrinsics: (5,) fx, fy, cx, cy in pixels, and the virtual disparity times depth in pixel metres.
        camera: Camera of the image.
        T_body_camera: (4, 4) pose of the camera in the body frame.
    """

    stamp_ns: int
    features: Features
    points_body: Points
    measured: Array
    weights: Array
    intrinsics: Array
    camera: PinholeCamera
    T_body_camera: Transform


RegisterPair = Callable[[IsvdObservation, IsvdObservation, MatchConfig], tuple[Alignment, float, int]]
"""Registration of two observations (target, source), as ``PairRegistration``."""


class PairRegistration:
    """Registration of one frame's features to those of an earlier one."""

    def __init__(self, config: IsvdConfig, *, by_pixels: bool) -> None:
        """Set the method.

        Args:
            config: Of ISVD.
            by_pixels: Refine ISVD's motion by the pixels, which is also a second test of it.
        """
        self._config = config
        self._isvd = Isvd(config)
        self._by_pixels = by_pixels

    def __call__(
        self, target: IsvdObservation, source: IsvdObservation, match: MatchConfig
    ) -> tuple[Alignment, float, int]:
        """Return the source's alignment to the target, its quality W (eq. 4.1), and the number of matches."""
        pairs = matched_pairs(target, source, match)
        return *self.fit(target, source, pairs), len(pairs)

    def fit(self, target: IsvdObservation, source: IsvdObservation, pairs: Pairs) -> tuple[Alignment, float]:
        """Return the alignment by matched features, and its quality W."""
        alignment, weight = self._isvd.fit_weighted(*shared_points(target, source, pairs))
        if self._by_pixels and alignment.converged:
            alignment = self._refined(target, source, pairs, alignment)
        return alignment, weight

    def agreeing(
        self, target: IsvdObservation, source: IsvdObservation, pairs: Pairs, T_target_source: Transform
    ) -> NDArray[np.bool_]:
        """Return (M,) which pairs agree with a motion."""
        points, seen = target.points_body[pairs[:, 0]], pairs[:, 1]
        if not self._by_pixels:
            miss_m = np.linalg.norm(points - apply(T_target_source, source.points_body[seen]), axis=1)
            near: NDArray[np.bool_] = miss_m <= self._config.agreement_mm / 1e3  # False without depth
            return near
        agree = np.zeros(len(pairs), np.bool_)
        T_camera_target = inverse(T_target_source @ source.T_body_camera)
        classify(
            T_camera_target, points, source.measured[seen], source.weights[seen], source.intrinsics, agree
        )
        return agree

    def _refined(
        self, target: IsvdObservation, source: IsvdObservation, pairs: Pairs, alignment: Alignment
    ) -> Alignment:
        """Return the motion of least reprojection error of the target's points in the source's image.

        Pixels and depth count by their noise, pairs by whether they pass the χ² test (Mur-Artal & Tardós
        2017, §III-C). ISVD's own pairs, weighted alike, are as good as the worst coordinate, the depth.
        """
        config = self._config
        pairs = pairs[np.isfinite(target.points_body[pairs[:, 0], 2])]
        points, measured, weights = (
            target.points_body[pairs[:, 0]],
            source.measured[pairs[:, 1]],
            source.weights[pairs[:, 1]],
        )
        T_camera_target, agree, _ = refine_pose(
            inverse(alignment.T_target_source @ source.T_body_camera),
            points,
            measured,
            weights,
            source.intrinsics,
            _ROUNDS,
            _ITERATIONS,
        )
        pairs, count, among = pairs[agree], int(agree.sum()), len(pairs)
        if count < max(config.min_agreeing, config.min_agreement_ratio * among, _MIN_FREEDOM_PAIRS):
            return failed(f"{count} of {among} pairs agree in the image")
        seen = T_camera_target, points[agree], measured[agree], weights[agree], source.intrinsics
        # The target's points were measured no better than the source's pixels, so the information is halved.
        information = 0.5 * normal_matrix(*seen) / variance_factor(*seen)
        to_camera = adjoint(inverse(source.T_body_camera))
        T_target_source = inverse(source.T_body_camera @ T_camera_target)
        points_target, points_source = shared_points(target, source, pairs)
        miss_m = np.linalg.norm(points_target - apply(T_target_source, points_source), axis=1)
        return replace(
            alignment,
            T_target_source=T_target_source,
            inlier_ratio=count / among,
            inlier_rmse_m=float(np.sqrt((miss_m**2).mean())) if len(miss_m) else 0.0,
            pairs=count,
            information=to_camera.T @ information @ to_camera,
        )


def matched_pairs(target: IsvdObservation, source: IsvdObservation, match: MatchConfig) -> Pairs:
    """Return the features that two frames share (Somlyai, PhD thesis, alg. 8).

    The ratio test is one of the new frame's features, the source's, as alg. 7 calls match with them first.
    """
    pairs = match_mutual(source.features, target.features, max_ratio=match.max_ratio)[:, ::-1]
    if match.filter == "homography":
        pairs = pairs[
            homography_inliers(
                target.features.pixels[pairs[:, 0]],
                source.features.pixels[pairs[:, 1]],
                seed=match.seed,
            )
        ]
    return pairs


def shared_points(target: IsvdObservation, source: IsvdObservation, pairs: Pairs) -> tuple[Points, Points]:
    """Return the (M, 3) points of the pairs with depth in both frames, each in its own body frame."""
    points_target, points_source = target.points_body[pairs[:, 0]], source.points_body[pairs[:, 1]]
    measured = np.isfinite(points_target[:, 2]) & np.isfinite(points_source[:, 2])
    return points_target[measured], points_source[measured]
