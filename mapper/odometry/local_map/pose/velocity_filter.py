"""Velocity filter: the next pose is predicted by a velocity to which well known poses contribute most."""

from collections import deque

import numpy as np

from mapper.core.geometry import Array, Transform, exp, inverse, log
from mapper.core.timebase import NS_PER_S
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose

_MAX_STEPS = 10.0
"""Over longer gaps, in frame intervals, constant velocity predicts worse than no motion."""
_MEMORY, _FEWEST = 100, 10
"""Changes of the velocity whose median is its spread; with fewer of them the last velocity counts alone."""
_MEDIAN_SQUARE = 2.366
"""Median of the squared length of a vector of three independent standard normal numbers."""

_MAX_CHI2 = 22.5
"""99.9 % of χ² of six degrees of freedom: after a larger change the velocity is the last one alone."""


class VelocityFilter:
    """Velocity of the body, a random walk that the motions from frame to frame measure (Kalman 1960).

    A motion is as uncertain as the poses that it connects. Along a direction that an image hardly shows the
    velocity is thus that of many frames, while elsewhere it is that of the last. One doubtful motion is left
    out: a passer-by may have caused it.
    """

    def __init__(self) -> None:
        self._changes: deque[tuple[float, float]] = deque(maxlen=_MEMORY)
        self.restart()

    def restart(self) -> None:
        """Reset the velocity, as after a gap."""
        self._velocity: Array | None = None
        self._covariance = np.zeros((6, 6))
        self._pose_covariance: Array | None = None
        self._elapsed_ns = 0
        self._left_out = False

    def predicted(self, stamp_ns: int, last: TrackedPose) -> Transform | None:
        """Return T_camera_world under constant velocity, also across dropped frames; None if unknown."""
        ahead_ns = stamp_ns - last.stamp_ns
        if self._velocity is None or ahead_ns > _MAX_STEPS * self._elapsed_ns:
            return None
        step = ahead_ns / NS_PER_S * self._velocity
        T_body_world = inverse(last.body_pose @ exp(step[:3], step[3:]))
        return inverse(last.observation.T_body_camera) @ T_body_world

    def add(
        self, tracked_pose: TrackedPose, covariance: Array, last: TrackedPose, *, is_doubtful: bool
    ) -> None:
        """Add a tracked frame.

        Args:
            tracked_pose: Its pose in the map as it is.
            covariance: (6, 6) of the pose in the body's tangent (rotation, translation).
            last: The frame before it.
            is_doubtful: The pose may be wrong.
        """
        before, self._pose_covariance = self._pose_covariance, covariance
        self._elapsed_ns = tracked_pose.stamp_ns - last.stamp_ns
        elapsed_s = self._elapsed_ns / NS_PER_S
        self._left_out = is_doubtful and self._velocity is not None and not self._left_out
        if self._left_out:
            return
        measured = np.concatenate(log(inverse(last.body_pose) @ tracked_pose.body_pose)) / elapsed_s
        noise = (covariance + (covariance if before is None else before)) / elapsed_s**2
        change = None if self._velocity is None else measured - self._velocity
        if change is None or not self._is_updated(change, noise, elapsed_s):
            self._velocity, self._covariance = measured, noise
        if change is not None and not is_doubtful:
            squares = np.square(change).reshape(2, 3).sum(axis=1) / elapsed_s
            self._changes.append((float(squares[0]), float(squares[1])))

    def _is_updated(self, change: Array, noise: Array, elapsed_s: float) -> bool:
        """Update the velocity by a measurement; False if too little is known or the velocity rules it out."""
        if self._velocity is None or len(self._changes) < _FEWEST:
            return False
        spread = np.median(self._changes, axis=0) / _MEDIAN_SQUARE * elapsed_s
        expected = self._covariance + np.diag(np.repeat(spread, 3))
        total = expected + noise
        if change @ np.linalg.solve(total, change) > _MAX_CHI2:
            return False
        gain = np.linalg.solve(total, expected).T
        self._velocity = self._velocity + gain @ change
        self._covariance = expected - gain @ expected
        return True
