"""Geometric verification of a loop between two images: ISVD on points, then reprojection in pixels.

From distances that differ by more than ORB bears, by about two, it is SIFT and P3P (``verify_wide``). The few
features that such views share may as well be those of an object that stands in two rooms, so that the whole
images have to agree.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import ConfigError
from mapper.core.frames import RgbdFrame
from mapper.core.geometry import Array, Points, Transform, adjoint, apply, inverse
from mapper.features.frame_view import FrameView, ImageView
from mapper.features.hamming import MAX_HAMMING, match_mutual_bits
from mapper.features.matching import Pairs, homography_inliers, match_mutual
from mapper.graph.measurement_covariance import MODEL_SHARE, inflated, with_model_error
from mapper.loops.base import Verification
from mapper.loops.config import ImageVerificationConfig
from mapper.registration.base import Alignment
from mapper.registration.degeneracy import degeneracy_of
from mapper.registration.image_agreement import ImageAgreement, image_agreement
from mapper.registration.isvd import Isvd
from mapper.registration.pair_refinement import refine
from mapper.registration.reprojection import (
    disparity_sigmas_px,
    image_measurements,
    normal_matrix,
    ransac_p3p,
    refine_pose,
    variance_factor,
)
from mapper.registration.surfaces import prepared
from mapper.sensing.config import KINECT_NOISE
from mapper.sensing.depth import depth_sigma_m

MAX_SIGMA_M = 0.05
"""A motion whose translation is less certain in any direction is no loop: far scenes leave it uncertain."""
_LM_ROUNDS, _LM_ITERATIONS = 4, 10
_P3P_PAIRS, _P3P_TOLERANCE_PX, _P3P_ITERATIONS = 4, 4.0, 300

_MAX_WIDE_RATIO = 0.85
_MIN_WIDE_INLIERS = 8
"""Random pairs agree with one motion by three to six, seldom by ten: fewer would only take longer."""
_MIN_SAME, _MAX_THROUGH, _MIN_CORRELATION = 0.8, 0.05, 0.6
"""Share of the surfaces at the same depth, share in space that the other image sees through, and correlation
of the grey levels. Views of one place give at least 0.89 and 0.7, and at most 0.03; those of an object that
stands in another room too, 0.8 where grey levels correlate by 0.5, and 0.6 where they do by 0.6."""
_MIN_LOCAL_CORRELATION = 0.4
"""The same correlation without the local mean and contrast. Two walls of a hall with posters alike gave 0.94
and 0.32 (once 0.43); views of one place give at least 0.46."""

_MIN_ZOOM = 1.5
"""Least ratio of the distances from which both see the place. From alike distances ORB recognises it; where
it does not, what agrees is a texture that repeats, as of the floor along a corridor."""

_ALIGNED_DEPTH_M, _ALIGNED_VOXEL_M = 4.0, 0.03
_ALIGNED_DISTANCES_M = (0.5, 0.2, 0.06)
"""Pairs from as far apart as a person leaves two clouds to twice a voxel."""
_ALIGNED_SIGMA_RAD, _ALIGNED_SIGMA_M = 0.016, 0.012
"""Error of surfaces alone, about and along each axis: 32 pairs of fr1_xyz are off by 0.027 rad and 2.2 cm
(medians) where GICP's own covariance would give 0.007 and 1.2 cm."""

FrameOf = Callable[[int], RgbdFrame]
"""Reads the frame of a stamp."""


class ImageVerifier:
    """Verifier of loops between images: features are paired, and a motion has to fit their points and pixels.

    The two tests err differently: ISVD (Somlyai, PhD thesis, alg. 7) needs depth on both sides and is as good
    as the points; reprojection (Mur-Artal & Tardós 2017, §III-C) is as good as the pixels, and alone would
    accept a far scene that hardly moves in the image. A loop has to pass both.
    """

    def __init__(self, config: ImageVerificationConfig) -> None:
        self._config = config
        self._isvd = Isvd(config.registration)

    def describe(self, seen: FrameView, /) -> ImageView:
        """Return the view as it is.

        Raises:
            ConfigError: It is the view of a scan.
        """
        if not isinstance(seen, ImageView):
            raise ConfigError("loops.kind=places and thesis compare images, and these are scans; want scans")
        return seen

    def verify(self, i: ImageView, j: ImageView) -> Verification:
        """Return the pose of view j in view i, or why they do not show one place."""
        config = self._config
        pairs = self._pairs(i, j)
        matches = len(pairs)
        if matches < config.min_matches:
            return Verification(matches, f"matching: {matches} pairs, want {config.min_matches}")
        pairs = pairs[i.has_depth(max_depth_m=config.max_depth_m)[pairs[:, 0]]]
        alignment = self._align(i, j, pairs)
        if not alignment.converged:
            alignment = self._align(i, j, self._consensus(i, j, pairs))
        if not alignment.converged:
            return Verification(matches, f"isvd: {alignment.reason}")
        return self._reproject(i, j, pairs, alignment, matches=matches)

    def _align(self, i: ImageView, j: ImageView, pairs: Pairs) -> Alignment:
        both = pairs[j.has_depth(max_depth_m=self._config.max_depth_m)[pairs[:, 1]]]
        return self._isvd.fit(i.points_camera[both[:, 0]], j.points_camera[both[:, 1]])

    def _consensus(self, i: ImageView, j: ImageView, pairs: Pairs) -> Pairs:
        """Return P3P's inlier pairs: ISVD begins with all pairs, and fails when most of them are wrong."""
        if len(pairs) < _P3P_PAIRS:
            return pairs[:0]
        found = ransac_p3p(
            i.points_camera[pairs[:, 0]],
            j.pixels[pairs[:, 1]],
            j.intrinsics,
            tolerance_px=_P3P_TOLERANCE_PX,
            iterations=_P3P_ITERATIONS,
            seed=self._config.match.seed,
        )
        return pairs[:0] if found is None else pairs[found[1]]

    def _pairs(self, i: ImageView, j: ImageView) -> Pairs:
        match = self._config.match
        if i.is_orb and j.is_orb:
            partner = match_mutual_bits(i.bits, j.bits, MAX_HAMMING, match.max_ratio)
            paired = np.flatnonzero(partner >= 0)
            pairs: Pairs = np.column_stack([paired, partner[paired]])
        else:
            pairs = match_mutual(i, j, max_ratio=match.max_ratio)
        if match.filter == "none":
            return pairs
        agree = homography_inliers(
            i.pixels[pairs[:, 0]].astype(np.float32),
            j.pixels[pairs[:, 1]].astype(np.float32),
            seed=match.seed,
        )
        return pairs[agree]

    def _reproject(
        self, i: ImageView, j: ImageView, pairs: Pairs, alignment: Alignment, *, matches: int
    ) -> Verification:
        """Refine ISVD's motion in j's image, and count the inliers."""
        config = self._config
        points = i.points_camera[pairs[:, 0]]
        measured, weights, intrinsics = _measurements(j, pairs[:, 1])
        T_j_i, agree, _ = refine_pose(
            inverse(alignment.T_target_source),
            points,
            measured,
            weights,
            intrinsics,
            _LM_ROUNDS,
            _LM_ITERATIONS,
        )
        inliers, rmse_m = int(agree.sum()), alignment.inlier_rmse_m
        wanted = max(config.min_inliers, config.min_inlier_ratio * len(pairs))
        if inliers < wanted:
            reason = f"reprojection: {inliers} of {len(pairs)} pairs agree, want {wanted:.0f}"
            return Verification(matches, reason, inliers, rmse_m)
        seen = T_j_i, points[agree], measured[agree], weights[agree], intrinsics
        residual_px = _rms_residual_px(*seen)
        T_ci_cj, information, scale = alignment.T_target_source, alignment.information, 1.0
        if config.measure == "reprojection":
            T_ci_cj = inverse(T_j_i)
            # i's points were measured no better than j's pixels, so the information is halved.
            information = 0.5 * normal_matrix(*seen)
            scale = 1.0 / variance_factor(*seen)
        assert information is not None  # ISVD converged
        T_i_j, information = _between_bodies(i, j, T_ci_cj, information)
        sigma_m = _largest_sigma_m(with_model_error(information, T_i_j))
        if sigma_m > MAX_SIGMA_M:
            reason = f"loose: translation known to {sigma_m:.2f} m, want {MAX_SIGMA_M} m"
            return Verification(matches, reason, inliers, rmse_m, residual_px)
        information = with_model_error(scale * information, T_i_j)
        return Verification(matches, "", inliers, rmse_m, residual_px, T_i_j, information)


def _between_bodies(
    i: ImageView, j: ImageView, T_ci_cj: Transform, information: Array
) -> tuple[Transform, Array]:
    """Return the pose of j's body in i's, and its information, by those of the cameras."""
    to_camera = adjoint(inverse(j.T_body_camera))
    T_i_j = i.T_body_camera @ T_ci_cj @ inverse(j.T_body_camera)
    return T_i_j, to_camera.T @ information @ to_camera


def _rms_residual_px(
    T_j_i: Transform, points: Points, measured: Array, weights: Array, intrinsics: Array
) -> float:
    """Return the root mean square of the weighted distances of projected points from their pixels."""
    points_j = apply(T_j_i, points)
    pixels = points_j[:, :2] / points_j[:, 2:] * intrinsics[:2] + intrinsics[2:4]
    miss_px = (pixels - measured[:, :2]) * (weights[:, :1] ** 0.5)
    return float(np.sqrt((miss_px**2).sum(axis=1).mean()))


def _largest_sigma_m(information: Array) -> float:
    """Return the standard deviation of a translation in its least certain direction."""
    return float(np.linalg.eigvalsh(np.linalg.inv(information)[3:, 3:])[-1] ** 0.5)


def _measurements(view: ImageView, features: NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Return (M, 3) u, v, bf/z, their (M, 3) inverse variances, and (5,) intrinsics.

    The disparity counts as much as the pixel.
    """
    sigma_px = view.sigma_px[features]
    return image_measurements(
        view.pixels[features],
        view.points_camera[features, 2],
        view.intrinsics,
        sigma_px=sigma_px,
        disparity_sigma_px=sigma_px,
    )


def verify_wide(i: ImageView, j: ImageView, frame_of: FrameOf) -> Verification:
    """Return the pose of view j in view i, or why they do not show one place.

    Args:
        i: SIFT features of one frame.
        j: Those of another.
        frame_of: Reads the two frames, only if the features agree.
    """
    pairs = match_mutual(i, j, max_ratio=_MAX_WIDE_RATIO)
    pairs = pairs[~np.isnan(i.points_camera[pairs[:, 0], 2])]
    matches = len(pairs)
    found = _pose(i, j, pairs)
    if found is None:
        return Verification(
            matches, f"matching: of {matches} pairs no {_MIN_WIDE_INLIERS} agree with one motion"
        )
    T_j_i, pairs = found
    zoom = _zoom(i, pairs, T_j_i)
    if max(zoom, 1.0 / zoom) < _MIN_ZOOM:
        reason = f"distance: seen from {zoom:.1f} times as far away, where ORB would have recognised it"
        return Verification(matches, reason, len(pairs))
    seen_i, seen_j = frame_of(i.stamp_ns), frame_of(j.stamp_ns)
    for alike in (image_agreement(seen_i, seen_j, T_j_i), image_agreement(seen_j, seen_i, inverse(T_j_i))):
        if not _is_one_place(alike):
            reason = (
                f"images: {alike.same_ratio:.0%} of the surfaces are at the same depth, and grey levels "
                f"correlate by {alike.correlation:.2f}, details by {alike.local_correlation:.2f}; "
                f"want {_MIN_SAME:.0%}, {_MIN_CORRELATION} and {_MIN_LOCAL_CORRELATION}"
            )
            return Verification(matches, reason, len(pairs))
    return _measured(i, j, pairs, T_j_i, matches=matches)


def verify_aligned(i: RgbdFrame, j: RgbdFrame, T_i_j: Transform) -> Verification:
    """Return the pose of frame j in frame i near one that was aligned by hand, or why the surfaces differ.

    GICP refines it. That it is one place is what the person has seen; the depth images have to agree.

    Args:
        i: One frame.
        j: Another one.
        T_i_j: (4, 4) pose of j's body in i's, to a few decimetres.
    """
    target, source = (
        prepared(frame.scan(max_depth_m=_ALIGNED_DEPTH_M).points_body, voxel_m=_ALIGNED_VOXEL_M)
        for frame in (i, j)
    )
    alignment = refine(target, source, T_i_j, kind="gicp", pair_distances_m=_ALIGNED_DISTANCES_M)
    if not alignment.converged or alignment.information is None:
        return Verification(0, f"gicp: {alignment.reason}")
    T_i_j = alignment.T_target_source
    T_j_i = inverse(j.T_body_camera) @ inverse(T_i_j) @ i.T_body_camera
    reason = degeneracy_of(alignment.information, points=source.points).reason
    for alike in (image_agreement(i, j, T_j_i), image_agreement(j, i, inverse(T_j_i))):
        if not reason and not _is_at_same_depth(alike):
            reason = (
                f"images: {alike.same_ratio:.0%} of the surfaces are at the same depth, want {_MIN_SAME:.0%}"
            )
    found = Verification(len(source.points), reason, alignment.pairs, alignment.inlier_rmse_m)
    if reason:
        return found
    information = inflated(alignment.information, sigma_rad=_ALIGNED_SIGMA_RAD, sigma_m=_ALIGNED_SIGMA_M)
    return replace(found, T_i_j=T_i_j, information=information)


def _zoom(i: ImageView, pairs: Pairs, T_j_i: Transform) -> float:
    """Return the distance of the paired points from camera j relative to that from camera i."""
    points_i = i.points_camera[pairs[:, 0]]
    distances_m = (np.linalg.norm(points, axis=1) for points in (points_i, apply(T_j_i, points_i)))
    near, far = (float(np.median(distance_m)) for distance_m in distances_m)
    return far / near


def _is_one_place(alike: ImageAgreement) -> bool:
    return (
        _is_at_same_depth(alike)
        and alike.correlation >= _MIN_CORRELATION
        and alike.local_correlation >= _MIN_LOCAL_CORRELATION
    )


def _is_at_same_depth(alike: ImageAgreement) -> bool:
    return alike.same_ratio >= _MIN_SAME and alike.through_ratio <= _MAX_THROUGH


def _pose(i: ImageView, j: ImageView, pairs: Pairs) -> tuple[Transform, Pairs] | None:
    """Return the pose of camera i in camera j with the pairs that agree; None if they are too few."""
    if len(pairs) < _MIN_WIDE_INLIERS:
        return None
    points, pixels = i.points_camera[pairs[:, 0]], j.pixels[pairs[:, 1]]
    found = ransac_p3p(
        points, pixels, j.intrinsics, tolerance_px=_P3P_TOLERANCE_PX, iterations=_P3P_ITERATIONS
    )
    if found is None or len(found[1]) < _MIN_WIDE_INLIERS:
        return None
    T_j_i, agreeing = found
    pairs = pairs[agreeing]
    T_j_i, agree, _ = refine_pose(
        T_j_i, points[agreeing], *_wide_measurements(j, pairs[:, 1]), _LM_ROUNDS, _LM_ITERATIONS
    )
    return (T_j_i, pairs[agree]) if agree.sum() >= _MIN_WIDE_INLIERS else None


def _measured(i: ImageView, j: ImageView, pairs: Pairs, T_j_i: Transform, *, matches: int) -> Verification:
    seen = (T_j_i, i.points_camera[pairs[:, 0]], *_wide_measurements(j, pairs[:, 1]))
    # i's points were measured no better than j's pixels, so the information is halved.
    information = 0.5 * normal_matrix(*seen) / variance_factor(*seen)
    T_i_j, information = _between_bodies(i, j, inverse(T_j_i), information)
    information = with_model_error(information, T_i_j)
    return Verification(matches, "", len(pairs), None, _rms_residual_px(*seen), T_i_j, information)


def _wide_measurements(view: ImageView, features: NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Return (M, 3) u, v, bf/z, their (M, 3) inverse variances, and (5,) intrinsics."""
    z = view.points_camera[features, 2]
    sigma_m = np.hypot(depth_sigma_m(KINECT_NOISE, z), MODEL_SHARE * z)
    return image_measurements(
        view.pixels[features],
        z,
        view.intrinsics,
        sigma_px=view.sigma_px[features],
        disparity_sigma_px=disparity_sigmas_px(z, sigma_m),
    )
