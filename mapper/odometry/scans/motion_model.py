"""Constant-velocity model of the sensor's motion, with the errors that its predictions had in this log."""

from dataclasses import dataclass

import numpy as np

from mapper.core.deskew import STILL, SampledMotion, Twist, twist_between
from mapper.core.geometry import Array, Transform, inverse, length_and_angle
from mapper.core.running_median import MEDIAN_LENGTH, RunningMedian
from mapper.core.timebase import NS_PER_S
from mapper.odometry.motion_prior import FEWEST_ERRORS, MotionPrior

_MIN_ELAPSED_S = 0.005  # over less, an error of millimetres becomes a large velocity
_ERRORS = 50  # of predictions: the newest in the median
_LEAST_M, _LEAST_RAD, _LEAST_SHARE = 2e-3, 1e-3, 0.02


@dataclass(frozen=True, slots=True)
class Spread:
    """Standard deviations of a predicted pose, of each axis: rad and m; and whether wheels predicted it."""

    rotation_rad: float
    translation_m: float
    is_by_wheels: bool = False


class _Errors:
    """Errors of predictions of one kind: running medians of their lengths, in rad and m."""

    def __init__(self) -> None:
        self._turns, self._shifts = RunningMedian(memory=_ERRORS), RunningMedian(memory=_ERRORS)

    def __len__(self) -> int:
        return len(self._turns)

    def add(self, error: Transform, time_s2: float = 1.0) -> None:
        """Add that of one prediction, in units of a time squared if it is an acceleration's."""
        shift_m, turn_rad = length_and_angle(error)
        self._turns.add(turn_rad / time_s2)
        self._shifts.add(shift_m / time_s2)

    @property
    def sigmas(self) -> tuple[float, float]:
        """Standard deviations of rotation and translation."""
        return self._turns.median / MEDIAN_LENGTH, self._shifts.median / MEDIAN_LENGTH


class MotionModel:
    """Motion of the body in the middle of each sweep.

    Attributes:
        T_world_last: (4, 4) pose in the middle of the last scan that was placed.
        twist: Velocity until then.
        prior: Predicts the motion since.
    """

    def __init__(self, time_ns: int, T_world_last: Transform, prior: MotionPrior) -> None:
        self.T_world_last = T_world_last
        self.twist: Twist = STILL
        self.prior = prior
        self._velocity_world = np.zeros(3)
        self._time_ns = time_ns
        self._elapsed_s = 0.0
        self._placed = 0
        self._covariance = np.zeros((6, 6))
        self._of_velocity, self._of_gyroscope, self._of_wheels = _Errors(), _Errors(), _Errors()

    def elapsed_s(self, time_ns: int) -> float:
        """Return the seconds since the last scan that was placed."""
        return (time_ns - self._time_ns) / NS_PER_S

    def predicted(self, time_ns: int) -> Transform:
        """Return T_world_body (4, 4) at a time, by the gyroscope, or if the velocity stays."""
        velocity_mps = self.T_world_last[:3, :3].T @ self._velocity_world
        return self.T_world_last @ self.prior.predict(self._time_ns, time_ns, self.twist, velocity_mps)

    def is_ruled_out(self, time_ns: int, T_world_body: Transform) -> bool:
        """Return whether the gyroscope rules out a pose (4, 4) at a time."""
        R_last_body = self.T_world_last[:3, :3].T @ T_world_body[:3, :3]
        return self.prior.reject(self._time_ns, time_ns, R_last_body)

    def is_by_wheels(self, time_ns: int) -> bool:
        """Return whether the wheels predict the pose at a time."""
        return self.prior.rolled(self._time_ns, time_ns) is not None

    def sweep(
        self, middle_ns: int, half_s: float, T_world_middle: Transform | None = None
    ) -> SampledMotion | None:
        """Return the motion about the middle of a sweep by the gyroscope; None if it does not know it.

        Args:
            middle_ns: Time of the middle.
            half_s: Half of the sweep's duration.
            T_world_middle: (4, 4) pose then, to which the velocity is the mean one; None if it is not known
                yet, and the velocity stays.
        """
        velocity_world, R_world_middle = self._velocity_world, self.T_world_last[:3, :3]
        if T_world_middle is None:
            turn = self.prior.turn(self._time_ns, middle_ns)
            R_world_middle = R_world_middle if turn is None else R_world_middle @ turn
        else:
            R_world_middle = T_world_middle[:3, :3]
            elapsed_s = self.elapsed_s(middle_ns)
            if elapsed_s >= _MIN_ELAPSED_S:
                velocity_world = (T_world_middle[:3, 3] - self.T_world_last[:3, 3]) / elapsed_s
        return self.prior.sweep(middle_ns, half_s, R_world_middle.T @ velocity_world)

    def rolling(self, middle_ns: int, half_s: float) -> SampledMotion | None:
        """Return the motion about the middle of a sweep by the wheels; None where none knows it."""
        half_ns = round(half_s * NS_PER_S)
        return self.prior.rolling(middle_ns - half_ns, middle_ns, middle_ns + half_ns) if half_ns else None

    def spread(self, time_ns: int) -> Spread | None:
        """Return the spread of a predicted pose; None before enough predictions could be compared.

        Errors are accelerations: they grow with the time since the last scan and since the one before it. A
        steady log is given two hundredths of the motion, so that its first acceleration is no surprise.
        """
        rolled = self.prior.rolled(self._time_ns, time_ns)
        if rolled is not None:
            return self._spread_of_wheels(rolled)
        is_turned = self.prior.turn(self._time_ns, time_ns) is not None
        is_known = is_turned and len(self._of_gyroscope) >= FEWEST_ERRORS
        return self._spread_by(self._of_gyroscope if is_known else self._of_velocity, time_ns)

    def _spread_by(self, errors: _Errors, time_ns: int) -> Spread | None:
        if len(errors) < FEWEST_ERRORS:
            return None
        elapsed_s = self.elapsed_s(time_ns)
        rotation, translation = errors.sigmas
        moved = float(np.linalg.norm(self.twist.translation_mps)) * elapsed_s
        turned = float(np.linalg.norm(self.twist.rotation_radps)) * elapsed_s
        time_s2 = _time_s2(elapsed_s, self._elapsed_s)
        return Spread(
            float(np.hypot(rotation * time_s2, _LEAST_RAD + _LEAST_SHARE * turned)),
            float(np.hypot(translation * time_s2, _LEAST_M + _LEAST_SHARE * moved)),
        )

    def _spread_of_wheels(self, rolled: Transform) -> Spread:
        """Return the spread of a motion by the wheels: the errors that they had, and those of most wheels."""
        moved, turned = length_and_angle(rolled)
        rotation, translation = self._of_wheels.sigmas
        noise = self.prior.wheel_noise
        return Spread(
            float(np.hypot(rotation, _LEAST_RAD + noise.turn_share * turned)),
            float(np.hypot(translation, _LEAST_M + noise.path_share * moved)),
            is_by_wheels=True,
        )

    def acceleration(self, time_ns: int, T_world_body: Transform, twist: Twist) -> float:
        """Return the angular acceleration to a velocity at a pose, at least the usual one, rad/s²."""
        usual, elapsed_s = self._of_velocity.sigmas[0], self.elapsed_s(time_ns)
        if elapsed_s < _MIN_ELAPSED_S:
            return usual
        change = twist.rotation_radps - self.mean_twist(time_ns, T_world_body).rotation_radps
        return max(usual, 2.0 * float(np.linalg.norm(change)) / elapsed_s)

    def velocity(self, time_ns: int, T_world_body: Transform) -> tuple[Twist, Array]:
        """Return the expected velocity at a pose, and its (6, 6) covariance, rotation before translation.

        Under white noise of the acceleration (Anderson & Barfoot 2015) the velocity w₁ after an interval t,
        given that before it, w₀, and the mean m, is 3/2 m − 1/2 w₀, with the variance qt/4; that of the pose
        predicted with w₀ is qt³/3.
        """
        mean = self.mean_twist(time_ns, T_world_body)
        expected = Twist(
            1.5 * mean.rotation_radps - 0.5 * self.twist.rotation_radps,
            1.5 * mean.translation_mps - 0.5 * self.twist.translation_mps,
        )
        return expected, np.diag(0.75 * self.velocity_sigmas(time_ns) ** 2) + 0.25 * self._covariance

    def velocity_sigmas(self, time_ns: int) -> Array:
        """Return (6,) standard deviations of what the velocity changes until a time, rad/s and m/s."""
        rolled, elapsed_s = self.prior.rolled(self._time_ns, time_ns), self.elapsed_s(time_ns)
        by_velocity = self._spread_by(self._of_velocity, time_ns)
        spread = by_velocity if rolled is None else self._spread_of_wheels(rolled)
        if spread is None or elapsed_s < _MIN_ELAPSED_S:
            sigmas = float(np.linalg.norm(self.twist.rotation_radps)), 0.0  # it may just have begun to turn
        else:
            sigmas = spread.rotation_rad / elapsed_s, spread.translation_m / elapsed_s
        return np.repeat(sigmas, 3)

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
        measured: tuple[Twist, Array] | None = None,
    ) -> None:
        """Take over the pose of a scan; an uncertain one says nothing on the errors of predictions.

        Args:
            time_ns: Of the pose.
            T_world_body: (4, 4) the pose.
            is_certain: Whether it is.
            measured: Velocity then and its (6, 6) covariance; None is the mean one since the last scan.
        """
        elapsed_s = self.elapsed_s(time_ns)
        self._placed += 1
        if elapsed_s >= _MIN_ELAPSED_S:
            if is_certain and self._placed > 1:  # the first is predicted without a velocity
                constant = self.twist.over(elapsed_s)
                T_last_body = inverse(self.T_world_last) @ T_world_body
                error = inverse(self.predicted(time_ns)) @ T_world_body
                time_s2 = _time_s2(elapsed_s, self._elapsed_s)
                self._of_velocity.add(inverse(constant) @ T_last_body, time_s2)
                if self.is_by_wheels(time_ns):
                    self._of_wheels.add(error)
                elif self.prior.turn(self._time_ns, time_ns) is not None:
                    self._of_gyroscope.add(error, time_s2)
                self.prior.learn_slip(self._time_ns, time_ns, T_last_body)
                self.prior.learn(self._time_ns, time_ns, T_last_body[:3, :3], constant[:3, :3])
            if measured is None:
                covariance = np.diag(self.velocity_sigmas(time_ns) ** 2)
                self.twist, self._covariance = self.mean_twist(time_ns, T_world_body), covariance
            else:
                self.twist, self._covariance = measured
            self._elapsed_s = elapsed_s if measured is None else 0.0
            self._velocity_world = (T_world_body[:3, 3] - self.T_world_last[:3, 3]) / elapsed_s
        self.T_world_last, self._time_ns = T_world_body, time_ns


def _time_s2(elapsed_s: float, before_s: float) -> float:
    """Return what an acceleration is multiplied by: from the middle of one interval over the next."""
    return 0.5 * elapsed_s * (elapsed_s + before_s)
