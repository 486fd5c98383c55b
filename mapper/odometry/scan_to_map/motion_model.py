"""Constant-velocity model of the sensor's motion, with the errors that its predictions had in this log."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.deskew import STILL, Twist, twist_between
from mapper.core.geometry import Array, Transform, angle_between, inverse
from mapper.core.timebase import NS_PER_S

_MIN_ELAPSED_S = 0.005  # over less, an error of millimetres becomes a large velocity
_ERRORS, _FEWEST_ERRORS = 50, 5  # of recent predictions: of so many the median is taken, of fewer none
_MEDIAN_LENGTH = 1.538  # of a vector of three independent normal errors, in standard deviations
_LEAST_M, _LEAST_RAD, _LEAST_SHARE = 2e-3, 1e-3, 0.02
_NO_VARIANCE = 1e-12  # (rad/s)² and (m/s)²: keeps a covariance of nothing invertible
_UNMEASURED = 0.25  # of what a velocity may change, where it is not measured


@dataclass(frozen=True, slots=True)
class Spread:
    """Standard deviations of a predicted pose, of each axis: rad and m."""

    rotation_rad: float
    translation_m: float


class MotionModel:
    """Motion of the body in the middle of each sweep.

    Attributes:
        T_world_last: (4, 4) pose in the middle of the last scan that was placed.
        twist: Velocity until then.
        pose_covariance: (6, 6) of that pose in the map, in its tangent.
    """

    def __init__(self, time_ns: int, T_world_last: Transform) -> None:
        self.T_world_last = T_world_last
        self.twist: Twist = STILL
        self.pose_covariance = np.zeros((6, 6))
        self._time_ns = time_ns
        self._elapsed_s = 0.0
        self._placed = 0
        self._covariance = np.zeros((6, 6))
        self._median = np.zeros(2)
        self._errors: deque[tuple[float, float]] = deque(maxlen=_ERRORS)

    def elapsed_s(self, time_ns: int) -> float:
        """Return the seconds since the last scan that was placed."""
        return (time_ns - self._time_ns) / NS_PER_S

    def predicted(self, time_ns: int) -> Transform:
        """Return T_world_body (4, 4) at a time, if the velocity stays."""
        return self.T_world_last @ self.twist.over(self.elapsed_s(time_ns))

    def spread(self, time_ns: int) -> Spread | None:
        """Return the spread of a predicted pose; None before enough predictions could be compared.

        Errors are accelerations: they grow with the time since the last scan and since the one before it. A
        steady log is given two hundredths of the motion, so that its first acceleration is not unusual.
        """
        if len(self._errors) < _FEWEST_ERRORS:
            return None
        elapsed_s = self.elapsed_s(time_ns)
        rotation, translation = self._median
        moved = float(np.linalg.norm(self.twist.translation_mps)) * elapsed_s
        turned = float(np.linalg.norm(self.twist.rotation_radps)) * elapsed_s
        time_s2 = _time_s2(elapsed_s, self._elapsed_s)
        return Spread(
            float(np.hypot(rotation * time_s2, _LEAST_RAD + _LEAST_SHARE * turned)),
            float(np.hypot(translation * time_s2, _LEAST_M + _LEAST_SHARE * moved)),
        )

    def turning_change(self, time_ns: int) -> float | None:
        """Return what the rotation rate may change until a time, rad/s; None before enough is known.

        A rate that was measured at the last scan makes the next pose better known, and the next rate not.
        """
        if len(self._errors) < _FEWEST_ERRORS:
            return None
        return max(float(self.velocity_sigmas(time_ns)[0]), float(self._median[0]) * self.elapsed_s(time_ns))

    def acceleration(self, time_ns: int, T_world_body: Transform, twist: Twist) -> float:
        """Return the angular acceleration to a velocity at a pose, at least the usual one, rad/s²."""
        usual, elapsed_s = float(self._median[0]), self.elapsed_s(time_ns)
        if elapsed_s < _MIN_ELAPSED_S:
            return usual
        change = twist.rotation_radps - self.mean_twist(time_ns, T_world_body).rotation_radps
        return max(usual, 2.0 * float(np.linalg.norm(change)) / elapsed_s)

    def velocity(self, time_ns: int, T_world_body: Transform, pose_covariance: Array) -> tuple[Twist, Array]:
        """Return the expected velocity at a pose, and its (6, 6) covariance, rotation before translation.

        Under white noise of the acceleration (Anderson & Barfoot 2015) the pose predicted over an interval t
        with the velocity before it, w₀, has an error of the variance S = qt³/3, w₀ one of 3S/t², and both
        have the covariance 3/2 S/t. Of the mean velocity m, whose poses have errors of the variance R, a gain
        of 3/2 S (S + R)⁻¹ is taken: 3/2 m − 1/2 w₀ with the variance 3/4 S/t² where poses are exact, and w₀
        where they are not known.

        Args:
            time_ns: Of the pose.
            T_world_body: (4, 4) the pose.
            pose_covariance: (6, 6) of it in the map, in its tangent.
        """
        elapsed_s = max(self.elapsed_s(time_ns), _MIN_ELAPSED_S)
        changed = np.diag(self.velocity_sigmas(time_ns) ** 2 + _NO_VARIANCE)  # S/t²
        of_mean = (self.pose_covariance + pose_covariance) / elapsed_s**2
        gain = 1.5 * changed @ np.linalg.inv(changed + of_mean)
        before, mean = self.twist.vector, self.mean_twist(time_ns, T_world_body).vector
        expected = before + gain @ (mean - before)
        kept = np.eye(6) - gain
        covariance = 3.0 * changed - 1.5 * (gain @ changed + changed @ gain.T)
        covariance += gain @ (changed + of_mean) @ gain.T + kept @ self._covariance @ kept.T
        return Twist.of(expected), covariance

    def velocity_sigmas(self, time_ns: int) -> Array:
        """Return (6,) standard deviations of what the velocity changes until a time, rad/s and m/s."""
        spread, elapsed_s = self.spread(time_ns), self.elapsed_s(time_ns)
        if spread is None or elapsed_s < _MIN_ELAPSED_S:
            sigmas = float(np.linalg.norm(self.twist.rotation_radps)), 0.0  # it may just have begun to turn
        else:
            sigmas = spread.rotation_rad / elapsed_s, spread.translation_m / elapsed_s
        return np.repeat(sigmas, 3)

    def change(self, time_ns: int, T_world_body: Transform) -> Array:
        """Return (6,) by how much the mean velocity to a pose differs from the one before, rad/s and m/s."""
        return _lengths(self.mean_twist(time_ns, T_world_body).vector - self.twist.vector)

    def mean_twist(self, time_ns: int, T_world_body: Transform) -> Twist:
        """Return the mean velocity from the last scan to a pose."""
        elapsed_s = self.elapsed_s(time_ns)
        if elapsed_s < _MIN_ELAPSED_S:
            return self.twist
        return twist_between(self.T_world_last, T_world_body, duration_s=elapsed_s)

    def follow(
        self,
        time_ns: int,
        T_world_body: Transform,
        *,
        is_certain: bool = True,
        pose_covariance: Array | None = None,
        measured: tuple[Twist, Array] | None = None,
    ) -> None:
        """Take over the pose of a scan; an uncertain one says nothing on the errors of predictions.

        Args:
            time_ns: Of the pose.
            T_world_body: (4, 4) the pose.
            is_certain: Whether it is.
            pose_covariance: (6, 6) of the pose in the map, in its tangent; None is that it is exact.
            measured: Velocity then and its (6, 6) covariance; None is the mean one since the last scan.
        """
        elapsed_s = self.elapsed_s(time_ns)
        self._placed += 1
        if elapsed_s >= _MIN_ELAPSED_S:
            if is_certain and self._placed > 1:  # the first is predicted without a velocity
                error = inverse(self.predicted(time_ns)) @ T_world_body
                lengths = angle_between(np.eye(3), error[:3, :3]), float(np.linalg.norm(error[:3, 3]))
                time_s2 = _time_s2(elapsed_s, self._elapsed_s)
                self._errors.append((lengths[0] / time_s2, lengths[1] / time_s2))
                self._median = np.median(np.array(self._errors), axis=0) / _MEDIAN_LENGTH
            if measured is None:
                covariance = np.diag(self.velocity_sigmas(time_ns) ** 2)
                self.twist, self._covariance = self.mean_twist(time_ns, T_world_body), covariance
            else:
                self.twist, self._covariance = measured
            self._elapsed_s = elapsed_s if measured is None else 0.0
        self.T_world_last, self._time_ns = T_world_body, time_ns
        self.pose_covariance = np.zeros((6, 6)) if pose_covariance is None else pose_covariance


def velocities_at(
    T_world_body: Sequence[Transform], elapsed_s: tuple[float, float]
) -> tuple[Twist, Twist, Array] | None:
    """Return the velocities of a parabola through three poses; None if two are of nearly one time.

    Args:
        T_world_body: Three (4, 4) poses, in time order.
        elapsed_s: Seconds between them.

    Returns:
        At the first pose, at the second, and (6,) by how much the mean velocity changes there, the same for
        all three axes of rotation and of translation.
    """
    if min(elapsed_s) < _MIN_ELAPSED_S:
        return None
    first, second, third = T_world_body
    before = twist_between(first, second, duration_s=elapsed_s[0]).vector
    after = twist_between(second, third, duration_s=elapsed_s[1]).vector
    step = (after - before) * elapsed_s[0] / sum(elapsed_s)
    at_first, at_second = before - step, before + step
    return Twist.of(at_first), Twist.of(at_second), _lengths(after - before)


def covariance_unmeasured(changes: Array) -> Array:
    """Return the (6, 6) covariance of a velocity that is not measured, by (6,) what it may change."""
    return np.diag((_UNMEASURED * changes) ** 2)


def _time_s2(elapsed_s: float, before_s: float) -> float:
    """Return what an acceleration is multiplied by: from the middle of one interval over the next."""
    return 0.5 * elapsed_s * (elapsed_s + before_s)


def _lengths(change: Array) -> Array:
    """Return (6,) the lengths of a change's rotation and of its translation, for all axes of each."""
    return np.repeat([float(np.linalg.norm(change[:3])), float(np.linalg.norm(change[3:]))], 3)
