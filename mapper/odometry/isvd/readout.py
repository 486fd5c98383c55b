"""Readout time of a rolling shutter, as a registered pair of images shows it."""

import numpy as np

from mapper.core.deskew import Twist
from mapper.core.geometry import Array, Transform, apply, inverse
from mapper.features.matching import Pairs
from mapper.odometry.isvd.registration import IsvdObservation
from mapper.odometry.local_map.bundle.bundle_adjustment import Observations, adjust, common_parameter
from mapper.odometry.local_map.calibration.rolling_shutter import camera_twist
from mapper.odometry.local_map.observation.pixel_motion import row_shift

_ROUNDS, _ITERATIONS = 2, 5
_NO_LINKS = np.empty((0, 2), np.int32), np.empty((0, 4, 4)), np.empty((0, 6, 6))


def readout_in_pair(
    target: IsvdObservation,
    source: IsvdObservation,
    pairs: Pairs,
    T_target_source: Transform,
    *,
    twists_body: tuple[Twist, Twist],
) -> tuple[float, float]:
    """Return the information on the readout time, s⁻², and the gradient of half the χ², s⁻¹.

    The source's pose and the points are adjusted to both images first, and then eliminated.

    Args:
        target: Earlier image, corrected by the readout time as it is known.
        source: New image, likewise.
        pairs: (M, 2) features of both.
        T_target_source: (4, 4) the registration.
        twists_body: Velocity of the body in the target's image and in the source's.
    """
    pairs = pairs[np.isfinite(target.points_body[pairs[:, 0], 2])]
    T_camera_body = inverse(target.T_body_camera)
    points = apply(T_camera_body, target.points_body[pairs[:, 0]])
    poses = np.array([np.eye(4), inverse(T_camera_body @ T_target_source @ source.T_body_camera)])
    count, free = len(points), np.array([-1, 0], np.int32)
    edges = np.column_stack([np.tile([0, 1], count), np.repeat(np.arange(count), 2)]).astype(np.int32)
    first_edge = np.arange(0, 2 * count + 1, 2, dtype=np.int32)

    def by_edge(of_target: Array, of_source: Array) -> Array:
        both = np.stack([of_target[pairs[:, 0]], of_source[pairs[:, 1]]], axis=1)
        return both.reshape(2 * count, -1)

    measured = by_edge(target.measured, source.measured)
    weights = by_edge(target.weights, source.weights)
    slopes = np.empty((2 * count, 2))
    for k, (seen, twist) in enumerate(zip((target, source), twists_body, strict=True)):
        slopes[k::2] = -row_shift(
            measured[k::2, :2],
            points[:, 2],
            seen.intrinsics,
            seen.camera.height_px,
            camera_twist(twist, seen.T_body_camera),
        )
    observed = Observations(first_edge, edges, measured, weights, source.intrinsics)
    poses, points, agree = adjust(poses, free, points, observed, _NO_LINKS, _ROUNDS, _ITERATIONS)
    return common_parameter(poses, free, points, observed, agree, slopes)
