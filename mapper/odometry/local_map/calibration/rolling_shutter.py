"""Rolling shutter: the rows of an image are exposed in turn, so a moving camera shifts their pixels."""

from dataclasses import replace
from typing import Protocol, Self, TypeVar

import numpy as np
from numba import njit

from mapper.core.deskew import Twist
from mapper.core.geometry import Array, Points, Transform, adjoint, inverse, log
from mapper.core.linear import solve_positive, twist_exp
from mapper.core.timebase import NS_PER_S
from mapper.odometry.local_map.observation.image_sweep import SweepErrors, image_sweep, swept_rows
from mapper.odometry.local_map.observation.readout_time import ReadoutTime
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose

_ITERATIONS = 2
_MIN_LANDMARKS = 50
"""With fewer the pose may be from depth, and the image does not show the motion."""
_FIRST_SPREAD = np.repeat([0.1, 0.05], 3)
"""Change of velocity (rad/s, m/s) from frame to frame before any is known."""
_LEAST_SPREAD = np.full(6, 0.01)
_SPREAD_KEPT = 0.95
_MAX_APART_S = 0.3
"""Poses farther apart do not determine the velocity at the time of an image."""


class ReadByRows(Protocol):
    """Observation of an image whose rows were read one after the other."""

    @property
    def T_body_camera(self) -> Transform:  # noqa: N802
        """(4, 4) pose of the camera in the body frame."""
        ...

    def swept(self, sweep_camera: Array, /) -> Self:
        """Return it corrected by the (6,) motion of the camera, in its own axes, while its rows were read."""
        ...


Observed = TypeVar("Observed", bound=ReadByRows)


class RollingShutter:
    """Correction of each image by the camera's motion while its rows were read.

    The motion is one more unknown of each image's pose (after Hedborg et al. 2012, §3), near the velocity
    that the last poses show. Without a readout time, as for a global shutter, nothing is changed.
    """

    def __init__(self, readout: ReadoutTime) -> None:
        """Start before the first image, with a readout time that may change later."""
        self._readout = readout
        self._variance = _FIRST_SPREAD**2
        self._velocity: Array | None = None
        self._elapsed_s = np.inf
        self._errors = SweepErrors()
        self.twist_camera = np.zeros(6)
        """Velocity of the camera in the last image, in its own axes: rotation rad/s, translation m/s."""

    def restart(self) -> None:
        """Reset the velocity, after a gap."""
        self._velocity, self._elapsed_s = None, np.inf
        self.twist_camera = np.zeros(6)
        self._errors.restart()

    @property
    def known_twist(self) -> Array | None:
        """``twist_camera``; None where the last images are too far apart to measure it."""
        return self.twist_camera if self._elapsed_s <= _MAX_APART_S else None

    def predicted(self, observation: Observed) -> Observed:
        """Return an observation corrected by the velocity in the image before."""
        return observation.swept(self._readout.seconds * self.twist_camera)

    def follow(self, T_before_camera: Transform, elapsed_s: float) -> None:
        """Set the velocity in the last image by the camera's motion (4, 4) since the image before it."""
        self._elapsed_s = elapsed_s
        velocity = np.concatenate(log(T_before_camera)) / elapsed_s
        change = np.zeros(6) if self._velocity is None else velocity - self._velocity
        self._velocity = velocity
        squares = np.repeat((change**2).reshape(2, 3).mean(axis=1), 3)
        self._variance = _SPREAD_KEPT * self._variance + (1.0 - _SPREAD_KEPT) * squares
        # The velocity is that of half an interval ago: half the last change is expected since, and about as
        # much is uncertain.
        self.twist_camera = velocity + 0.5 * change

    def refined(
        self, tracked_pose: TrackedPose, before: TrackedPose, points_world: Points, weights: Array
    ) -> TrackedPose:
        """Return a pose and its observation, corrected by the motion that both the poses and the image show.

        Args:
            tracked_pose: Of an image corrected as predicted.
            before: Of the image before it.
            points_world: (M, 3) landmarks of its inliers, in the order of their features.
            weights: (M, 3) inverse variances of their pixels and disparities.
        """
        observation = tracked_pose.observation
        self.follow(
            before.T_camera_world @ inverse(tracked_pose.T_camera_world),
            (observation.stamp_ns - before.observation.stamp_ns) / NS_PER_S,
        )
        velocity = self._velocity if self._elapsed_s <= _MAX_APART_S else None
        self._errors.follow(velocity)
        if len(points_world) < _MIN_LANDMARKS:
            return tracked_pose
        features = np.flatnonzero(tracked_pose.landmark_of_feature >= 0)
        measured = np.column_stack([observation.pixels[features], observation.measured[features, 2]])
        image = points_world, measured, weights, observation.intrinsics, observation.size_px[1]
        readout_s, sweep_camera, refined_pose = self._readout.seconds, np.zeros(6), tracked_pose
        if readout_s != 0.0:
            sigma = 0.5 * np.sqrt(self._variance) + _LEAST_SPREAD
            T_camera_world, sweep_camera = _refine(
                tracked_pose.T_camera_world,
                readout_s * self.twist_camera,
                (readout_s * sigma) ** -2.0,
                *image,
            )
            self.twist_camera = sweep_camera / readout_s
            refined_pose = replace(
                tracked_pose, observation=observation.swept(sweep_camera), T_camera_world=T_camera_world
            )
        if velocity is not None:
            self._errors.add(image_sweep(tracked_pose.T_camera_world, *image), velocity, sweep_camera)
        return refined_pose

    def pose_covariance(self, T_body_camera: Transform) -> Array:
        """Return the (6, 6) covariance of the last pose by motion that was not taken out, body tangent."""
        Ad_body_camera = adjoint(T_body_camera)
        return Ad_body_camera @ self._errors.pose_covariance @ Ad_body_camera.T

    def twist_body(self, observation: ReadByRows) -> Twist:
        """Return the velocity in the last image, in the body's axes."""
        twist = adjoint(observation.T_body_camera) @ self.twist_camera
        return Twist.of(twist)

    def corrected(self, observation: Observed, twist_body: Twist) -> Observed:
        """Return an observation corrected by a velocity of the body."""
        return observation.swept(self._readout.seconds * camera_twist(twist_body, observation.T_body_camera))


def camera_twist(twist_body: Twist, T_body_camera: Transform) -> Array:
    """Return (6,) a body's velocity as its camera's, in the camera's axes: rotation, translation."""
    twist: Array = adjoint(inverse(T_body_camera)) @ np.concatenate(
        [twist_body.rotation_radps, twist_body.translation_mps]
    )
    return twist


@njit(cache=True, nogil=True)
def _refine(T_camera_world, expected_sweep, information, points, measured, weights, intrinsics, height_px):  # type: ignore[no-untyped-def]
    """Return T_camera_world when the middle row was read, and the camera's motion over all rows (6,).

    Gauss–Newton on both; ``measured`` is as it was read, and the motion has a normal prior.
    """
    T, sweep = T_camera_world.copy(), expected_sweep.copy()
    r, J_both, scratch = np.empty(3), np.zeros((3, 12)), (np.empty((3, 3)), np.empty((3, 6)))
    H, g = np.empty((12, 12)), np.empty(12)
    for _ in range(_ITERATIONS):
        H[:, :] = 0.0
        g[:] = 0.0
        for a in range(6):
            H[6 + a, 6 + a] = information[a]
            g[6 + a] = information[a] * (expected_sweep[a] - sweep[a])
        for n in range(len(points)):
            swept_rows(T, points[n], measured[n], sweep, intrinsics, height_px, scratch, r, J_both)
            for i in range(3):
                for a in range(12):
                    wa = weights[n, i] * J_both[i, a]
                    g[a] += wa * r[i]
                    for b in range(a, 12):
                        H[a, b] += wa * J_both[i, b]
        for a in range(12):
            for b in range(a):
                H[a, b] = H[b, a]
            H[a, a] += 1e-9
        step = solve_positive(H, g)
        T = twist_exp(step[:6], T)
        sweep += step[6:]
    return T, sweep
