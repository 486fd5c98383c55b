"""Rolling shutter: the rows of an image are exposed in turn, so a moving camera shifts their pixels."""

from dataclasses import replace

import numpy as np
from numba import njit

from mapper.core.deskew import Twist
from mapper.core.geometry import Array, Points, adjoint, inverse, log
from mapper.core.linear import solve_positive, twist_exp
from mapper.core.timebase import NS_PER_S
from mapper.odometry.camera.image_observation import ImageObservation
from mapper.odometry.camera.pixel_motion import line_phase
from mapper.odometry.camera.readout_time import ReadoutTime
from mapper.odometry.keyframes.pose_tracker import TrackedPose
from mapper.registration.reprojection import linearise

_ITERATIONS = 2
_MIN_LANDMARKS = 50
"""With fewer the pose may be from depth, and the image does not show the motion."""
_FIRST_SPREAD = np.repeat([0.1, 0.05], 3)
"""Change of velocity (rad/s, m/s) from frame to frame before any is known."""
_LEAST_SPREAD = np.full(6, 0.01)
_SPREAD_KEPT = 0.95


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
        self.twist_camera = np.zeros(6)
        """Velocity of the camera in the last image, in its own axes: rotation rad/s, translation m/s."""

    def restart(self) -> None:
        """Forget the velocity, after a gap."""
        self._velocity = None
        self.twist_camera = np.zeros(6)

    def predict(self, observation: ImageObservation) -> ImageObservation:
        """Return an observation corrected by the velocity in the image before."""
        return observation.swept(self._readout.seconds * self.twist_camera)

    def refine(self, tracked_pose: TrackedPose, before: TrackedPose, points_world: Points) -> TrackedPose:
        """Return a pose and its observation, corrected by the motion that both the poses and the image show.

        Args:
            tracked_pose: Of an image corrected as predicted.
            before: Of the image before it.
            points_world: (M, 3) landmarks of its inliers, in the order of their features.
        """
        observation = tracked_pose.observation
        elapsed_s = (observation.stamp_ns - before.observation.stamp_ns) / NS_PER_S
        moved = log(before.T_camera_world @ inverse(tracked_pose.T_camera_world))
        velocity = np.concatenate(moved) / elapsed_s
        change = np.zeros(6) if self._velocity is None else velocity - self._velocity
        self._velocity = velocity
        squares = np.repeat((change**2).reshape(2, 3).mean(axis=1), 3)
        self._variance = _SPREAD_KEPT * self._variance + (1.0 - _SPREAD_KEPT) * squares
        # The velocity is that of half an interval ago: half the last change is expected since, and about as
        # much is uncertain.
        self.twist_camera = velocity + 0.5 * change
        readout_s = self._readout.seconds
        if readout_s == 0.0 or len(points_world) < _MIN_LANDMARKS:
            return tracked_pose
        sigma = 0.5 * np.sqrt(self._variance) + _LEAST_SPREAD
        features = np.flatnonzero(tracked_pose.landmark_of_feature >= 0)
        T_camera_world, sweep_camera = _refine(
            tracked_pose.T_camera_world,
            readout_s * self.twist_camera,
            (readout_s * sigma) ** -2.0,
            points_world,
            np.column_stack([observation.pixels[features], observation.measured[features, 2]]),
            observation.weights[features],
            observation.intrinsics,
            line_phase(observation.pixels[features], observation.size_px),
        )
        self.twist_camera = sweep_camera / readout_s
        return replace(
            tracked_pose, observation=observation.swept(sweep_camera), T_camera_world=T_camera_world
        )

    def twist_body(self, observation: ImageObservation) -> Twist:
        """Return the velocity in the last image, in the body's axes."""
        return Twist.of(adjoint(observation.T_body_camera) @ self.twist_camera)

    def correct(self, observation: ImageObservation, twist_body: Twist) -> ImageObservation:
        """Return an observation corrected by a velocity of the body."""
        twist = adjoint(inverse(observation.T_body_camera)) @ twist_body.vector
        return observation.swept(self._readout.seconds * twist)


@njit(cache=True, nogil=True)
def _refine(T_camera_world, expected_sweep, information, points, measured, weights, intrinsics, phases):
    """Return T_camera_world when the middle line was read, and the camera's motion over all lines (6,).

    Gauss–Newton on both; ``measured`` is as it was read, and the motion has a normal prior.
    """
    T, sweep = T_camera_world.copy(), expected_sweep.copy()
    r = np.empty(3)
    J, J_pose, J_both = np.empty((3, 3)), np.empty((3, 6)), np.zeros((3, 12))
    H, g = np.empty((12, 12)), np.empty(12)
    for _ in range(_ITERATIONS):
        H[:, :] = 0.0
        g[:] = 0.0
        for a in range(6):
            H[6 + a, 6 + a] = information[a]
            g[6 + a] = information[a] * (expected_sweep[a] - sweep[a])
        for n in range(len(points)):
            linearise(T, points[n], measured[n], intrinsics, r, J, J_pose)
            for i in range(3):
                for a in range(6):
                    J_both[i, a] = J_pose[i, a]
                    # A point moves against the camera; the disparity's change is taken out of it already.
                    J_both[i, 6 + a] = -phases[n] * J_pose[i, a] if i < 2 else 0.0
                    r[i] -= J_both[i, 6 + a] * sweep[a]
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
