"""Wide-baseline verification of a loop: a motion by SIFT and P3P, with which the whole images have to agree.

ORB is found again over a change of scale by about two, SIFT by four. The few features that such views share
may as well be those of an object that stands in two rooms, so that features alone do not decide.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import RgbdFrame
from mapper.core.geometry import Array, Transform, adjoint, apply, inverse
from mapper.features.frame_view import ImageView
from mapper.features.matching import Pairs, match_mutual
from mapper.graph.uncertainty import with_model_error
from mapper.loops.base import Verification
from mapper.loops.image_verification import rms_residual_px
from mapper.registration.image_agreement import ImageAgreement, image_agreement
from mapper.registration.reprojection import (
    disparity_sigmas_px,
    image_measurements,
    normal_matrix,
    ransac_p3p,
    refine_pose,
    residual_statistics,
)
from mapper.sensing.config import KINECT_NOISE
from mapper.sensing.depth_noise import depth_sigma_m

_MAX_RATIO = 0.85
_TOLERANCE_PX, _ITERATIONS = 4.0, 300
_ROUNDS, _LM_ITERATIONS = 4, 10
_DEPTH_SHARE = 0.02
"""Error of depths beside the sensor's noise: its scale, and the slope where a feature lies."""
_MIN_INLIERS = 8
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

FrameOf = Callable[[int], RgbdFrame]
"""Reads the frame of a stamp."""


def verify_wide(i: ImageView, j: ImageView, frame_of: FrameOf) -> Verification:
    """Return the pose of view j in view i, or why they do not show one place.

    Args:
        i: SIFT features of one frame.
        j: Those of another.
        frame_of: Reads the two frames, only if the features agree.
    """
    pairs = match_mutual(i, j, max_ratio=_MAX_RATIO)
    pairs = pairs[~np.isnan(i.points_camera[pairs[:, 0], 2])]
    matches = len(pairs)
    found = _pose(i, j, pairs)
    if found is None:
        return Verification(matches, f"matching: of {matches} pairs no {_MIN_INLIERS} agree with one motion")
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


def _zoom(i: ImageView, pairs: Pairs, T_j_i: Transform) -> float:
    """Return the distance of the paired points from camera j relative to that from camera i."""
    points_i = i.points_camera[pairs[:, 0]]
    distances_m = (np.linalg.norm(points, axis=1) for points in (points_i, apply(T_j_i, points_i)))
    near, far = (float(np.median(distance_m)) for distance_m in distances_m)
    return far / near


def _is_one_place(alike: ImageAgreement) -> bool:
    return (
        alike.same_ratio >= _MIN_SAME
        and alike.through_ratio <= _MAX_THROUGH
        and alike.correlation >= _MIN_CORRELATION
        and alike.local_correlation >= _MIN_LOCAL_CORRELATION
    )


def _pose(i: ImageView, j: ImageView, pairs: Pairs) -> tuple[Transform, Pairs] | None:
    """Return the pose of camera i in camera j with the pairs that agree; None if they are too few."""
    if len(pairs) < _MIN_INLIERS:
        return None
    points, pixels = i.points_camera[pairs[:, 0]], j.pixels[pairs[:, 1]]
    found = ransac_p3p(points, pixels, j.intrinsics, tolerance_px=_TOLERANCE_PX, iterations=_ITERATIONS)
    if found is None or len(found[1]) < _MIN_INLIERS:
        return None
    T_j_i, agreeing = found
    pairs = pairs[agreeing]
    T_j_i, agree, _ = refine_pose(
        T_j_i, points[agreeing], *_measurements(j, pairs[:, 1]), _ROUNDS, _LM_ITERATIONS
    )
    return (T_j_i, pairs[agree]) if agree.sum() >= _MIN_INLIERS else None


def _measured(i: ImageView, j: ImageView, pairs: Pairs, T_j_i: Transform, *, matches: int) -> Verification:
    seen = (T_j_i, i.points_camera[pairs[:, 0]], *_measurements(j, pairs[:, 1]))
    # i's points were measured no better than j's pixels, so the information is halved.
    information = 0.5 * normal_matrix(*seen) / residual_statistics(*seen).variance_factor
    to_camera = adjoint(inverse(j.T_body_camera))
    T_i_j = i.T_body_camera @ inverse(T_j_i) @ inverse(j.T_body_camera)
    information = with_model_error(to_camera.T @ information @ to_camera, T_i_j)
    return Verification(matches, "", len(pairs), None, rms_residual_px(*seen), T_i_j, information)


def _measurements(view: ImageView, features: NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Return (M, 3) u, v, bf/z, their (M, 3) inverse variances, and (5,) intrinsics."""
    z = view.points_camera[features, 2]
    sigma_m = np.hypot(depth_sigma_m(KINECT_NOISE, z), _DEPTH_SHARE * z)
    return image_measurements(
        view.pixels[features],
        z,
        view.intrinsics,
        sigma_px=view.sigma_px[features],
        disparity_sigma_px=disparity_sigmas_px(z, sigma_m),
    )
