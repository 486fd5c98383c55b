"""Prior of the body's motion: wheels, the rotation by a gyroscope where that is better, constant velocity."""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from mapper.core.deskew import SampledMotion, Twist
from mapper.core.geometry import Array, Transform, angle_between, angle_of, inverse
from mapper.core.running_median import MEDIAN_LENGTH, RunningMedian
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.core.trajectory import Trajectory
from mapper.graph.config import WheelNoiseConfig
from mapper.odometry.gyroscope_calibration import (
    DEGREES,
    GyroscopeCalibration,
    calibrate,
    offset_by_speeds,
    uncalibrated,
)
from mapper.sensing.gyroscope import Gyroscope
from mapper.sensing.sweep_motion import motion_by_wheels, sampled_motion
from mapper.sensing.wheel_kinematics import pose_at

_FIRST_FIT, _FITS_GROW, _MOST_BETWEEN_FITS = 8, 1.5, 100
_KEPT = 400  # intervals that a fit uses: bias drifts over minutes
_ERRORS, FEWEST_ERRORS = 30, 5  # of predictions: the newest in the median, and fewest for one
_MOST_REJECTED_FRAMES = 15
"""In a row: as many as images, and more than scans, are lost before a new sub-map begins."""
_LONGEST_TURN_RAD = 2.8
_SLIPPED, _STANDING_M = 0.5, 0.05
"""Median miss of the wheels, as a share of the way and 5 cm, from which on constant velocity predicts better:
they slip, their mounting or their clock is wrong."""
_MOST_BETWEEN_READINGS_NS = NS_PER_S
_ANOTHER_RAD = 0.2  # of a mounting that contradicts tf's
_ANOTHER_UNIT, _ANOTHER_CLOCK_S = 1.25, 0.2
_CONTRADICTION_RAD, _CONTRADICTION_SIGMAS = 0.2, 6.0  # far beyond any error but that of a wrong pose


class MotionPrior:
    """Prediction of the body's motion between two times.

    Without a gyroscope it is that of a constant velocity. The gyroscope's calibration is estimated from the
    rotations that the odometry measures; it is used where its standard deviation, that of the calibration
    and of its last errors, is below that of constant velocity. So one whose mounting the motion has not
    shown yet, or whose readings contradict the odometry, is not used.
    """

    def __init__(
        self,
        gyroscope: Gyroscope | None,
        wheels: Trajectory | None = None,
        wheel_noise: WheelNoiseConfig | None = None,
    ) -> None:
        """Begin before the first frame.

        Args:
            gyroscope: Angular velocities of the log, if it has any.
            wheels: T_odom_body of its wheel odometry, if that predicts the motion.
            wheel_noise: Errors of most wheels; None is those of the defaults.
        """
        self.wheel_noise = wheel_noise or WheelNoiseConfig()
        self._wheels = wheels
        self._wheel_misses = RunningMedian(memory=_ERRORS)
        self._gyroscope = gyroscope
        self._calibration = None if gyroscope is None else uncalibrated(gyroscope)
        self._of_body: Gyroscope | None = None  # made when it is needed
        self._turns: dict[tuple[int, int], tuple[Array, float] | None] = {}  # of the frame that is tracked
        self._intervals: deque[tuple[int, int, Array]] = deque(maxlen=_KEPT)
        self._errors: deque[float] = deque(maxlen=_ERRORS)
        self._errors_without: deque[float] = deque(maxlen=_ERRORS)
        self._measured = 0
        self._next_fit = _FIRST_FIT
        self._used = self._uncovered = 0
        self._rejected_frames, self._last_rejected_ns = 0, -1

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without what is made again when it is needed."""
        return {**self.__dict__, "_of_body": None, "_turns": {}}

    def begin_calibrated(self, calibration: GyroscopeCalibration, frames: int) -> None:
        """Begin with the gyroscope's calibration by the first frames; it is fitted again after as many."""
        self._calibration, self._next_fit = calibration, frames

    def turn(self, begin_ns: int, end_ns: int) -> Array | None:
        """Return the rotation (3, 3) of the body between two times; None if constant velocity is better."""
        found = self._turn(begin_ns, end_ns)
        return None if found is None or not self._is_better(*found) else found[0]

    def predict(self, begin_ns: int, end_ns: int, twist: Twist, velocity_mps: Array) -> Transform:
        """Return T_begin_end (4, 4).

        Args:
            begin_ns: Time of the last pose.
            end_ns: A later time.
            twist: Mean velocity until then, which stays without a gyroscope.
            velocity_mps: (3,) mean velocity until then in the world, which stays with one, in the body's axes
                at the last pose.
        """
        elapsed_s = (end_ns - begin_ns) / NS_PER_S
        rolled = self.rolled(begin_ns, end_ns)
        if rolled is not None:
            return rolled
        R_begin_end = self.turn(begin_ns, end_ns)
        if R_begin_end is None:
            return twist.over(elapsed_s)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R_begin_end, elapsed_s * velocity_mps
        return T

    def rolled(self, begin_ns: int, end_ns: int) -> Transform | None:
        """Return T_begin_end (4, 4) by the wheels; None without readings, or if they have been wrong."""
        if len(self._wheel_misses) >= FEWEST_ERRORS and self._wheel_misses.median > _SLIPPED:
            return None
        return self._rolled(begin_ns, end_ns)

    def rolling(self, begin_ns: int, zero_ns: int, end_ns: int) -> SampledMotion | None:
        """Return the motion about a time by the wheels; None as for ``rolled``."""
        if self._wheels is None or self.rolled(begin_ns, end_ns) is None:
            return None
        return motion_by_wheels(self._wheels, begin_ns, zero_ns, end_ns)

    def _rolled(self, begin_ns: int, end_ns: int) -> Transform | None:
        if self._wheels is None:
            return None
        T_odom_begin, T_odom_end = (
            pose_at(self._wheels, time_ns, max_gap_ns=_MOST_BETWEEN_READINGS_NS)
            for time_ns in (begin_ns, end_ns)
        )
        return None if T_odom_begin is None or T_odom_end is None else inverse(T_odom_begin) @ T_odom_end

    def learn_slip(self, begin_ns: int, end_ns: int, T_begin_end: Transform) -> None:
        """Take over the motion that the odometry measured between two frames, for the trust in the wheels."""
        rolled = self._rolled(begin_ns, end_ns)
        if rolled is None:
            return
        moved_m = float(np.linalg.norm(T_begin_end[:3, 3]))
        miss_m = float(np.linalg.norm(rolled[:3, 3] - T_begin_end[:3, 3]))
        self._wheel_misses.add(miss_m / (moved_m + _STANDING_M))

    def sweep(self, middle_ns: int, half_s: float, velocity_mps: Array) -> SampledMotion | None:
        """Return the motion about the middle of a sweep; None if the gyroscope does not know it.

        Args:
            middle_ns: Time of the middle.
            half_s: Half of its duration.
            velocity_mps: (3,) in the body's axes in the middle.
        """
        half_ns = round(half_s * NS_PER_S)
        begin_ns, end_ns = middle_ns - half_ns, middle_ns + half_ns
        if not half_ns or self.turn(begin_ns, end_ns) is None:
            return None
        assert self._gyroscope is not None
        assert self._calibration is not None
        if self._of_body is None:
            self._of_body = self._calibration.applied_to(self._gyroscope)
        return sampled_motion(self._of_body, begin_ns, middle_ns, end_ns, velocity_mps)

    def spread_radps(self) -> float:
        """Return the standard deviation of the angular velocity that the gyroscope gives, rad/s."""
        assert self._calibration is not None
        return float(np.sqrt(np.diag(self._calibration.covariance)[3:6].max()))

    def learn(self, begin_ns: int, end_ns: int, R_begin_end: Array, R_constant: Array) -> None:
        """Take over the rotation that the odometry measured between two frames.

        Args:
            begin_ns: Time of the first frame.
            end_ns: Time of the second.
            R_begin_end: (3, 3) measured rotation.
            R_constant: (3, 3) by constant velocity.
        """
        gyroscope = self._gyroscope
        if gyroscope is None or angle_of(R_begin_end) > _LONGEST_TURN_RAD:
            return
        found = self._turn(begin_ns, end_ns)
        self._turns.clear()
        if found is None:
            self._uncovered += 1
            return
        self._used += self._is_better(*found)
        self._errors.append(angle_between(found[0], R_begin_end))
        self._errors_without.append(angle_between(R_constant, R_begin_end))
        self._intervals.append((begin_ns, end_ns, R_begin_end))
        self._measured += 1
        if self._measured >= self._next_fit:
            self._fit(gyroscope)
            grown = round(self._measured * _FITS_GROW)
            self._next_fit = min(grown, self._measured + _MOST_BETWEEN_FITS)

    def reject(self, begin_ns: int, end_ns: int, R_begin_end: Array) -> bool:
        """Return whether the gyroscope rules out a rotation (3, 3) of the body between two times.

        One that rules out all poses of many frames in a row has become wrong itself, and rejects nothing
        until a pose agrees with it again.
        """
        found = self._turn(begin_ns, end_ns)
        if found is None or len(self._errors) < FEWEST_ERRORS or not self._is_better(*found):
            return False
        sigma_rad = math.hypot(found[1], float(np.median(self._errors)) / MEDIAN_LENGTH)
        off_rad = angle_between(found[0], R_begin_end)
        if off_rad <= max(_CONTRADICTION_RAD, _CONTRADICTION_SIGMAS * sigma_rad):
            self._rejected_frames = 0
            return False
        if end_ns != self._last_rejected_ns:
            self._last_rejected_ns = end_ns
            self._rejected_frames += 1
        return self._rejected_frames <= _MOST_REJECTED_FRAMES

    @property
    def calibration(self) -> GyroscopeCalibration | None:
        """The gyroscope's calibration, if it predicts the last rotations better than constant velocity."""
        if not self._used or np.median(self._errors) >= np.median(self._errors_without):
            return None
        return self._calibration

    def notes(self) -> list[str]:
        """Return how the gyroscope was used and calibrated, and what contradicts it, a sentence each."""
        gyroscope, found = self._gyroscope, self._calibration
        if gyroscope is None or found is None:
            return []
        name = f"gyroscope {gyroscope.name}, {NS_PER_S / gyroscope.interval_ns:.0f} Hz"
        unit = DEGREES if abs(found.scale) == DEGREES else 1.0
        notes = []
        if unit == DEGREES:
            notes.append(
                f"{name}: its angular velocities are in degrees a second, by the turns of the frames"
            )
        elif not 1.0 / _ANOTHER_UNIT < found.ratio < _ANOTHER_UNIT:
            notes.append(
                f"{name}: the frames turn {found.ratio:.2g} times as much as it says; is its unit rad/s?"
            )
        if found.scale < 0.0:
            notes.append(f"{name}: its axes are left-handed: one of them is flipped; corrected")
        sigmas = np.sqrt(np.diag(found.covariance))
        stated = gyroscope.R_body_imu
        origin = "found from the log"
        if stated is not None:
            off = angle_between(stated.T, found.R_body_imu.T)
            origin = "from tf"
            if off > _ANOTHER_RAD and found.is_mounting_known:
                notes.append(
                    f"{name}: tf has it {np.degrees(off):.0f}° from where the turns of the frames have it; "
                    "the latter is used"
                )
                origin = "found from the log"
        if self._uncovered > self._measured:
            notes.append(
                f"{name}: no readings at the times of {self._uncovered} of "
                f"{self._uncovered + self._measured} frames; has it another clock?"
            )
        is_unused = bool(self._intervals) and self.calibration is None
        offset_s = offset_by_speeds(gyroscope, *self._turns_measured()) if is_unused else None
        if offset_s is not None and abs(offset_s - found.offset_s) > _ANOTHER_CLOCK_S:
            late = f"{abs(offset_s):.2f} s {'late' if offset_s > 0.0 else 'early'}"
            notes.append(
                f"{name}: its stamps are {late}, by the turns of the frames; is its clock right? "
                f"source.imu_offset_s={-offset_s:.2f} corrects that"
            )
        if not self._used and self._measured:
            notes.append(
                f"{name}: not used: constant velocity predicts the frames' rotations as well or better"
            )
        if not self._used:
            return notes
        bias = np.degrees(np.linalg.norm(found.bias))
        notes.append(
            f"{name}, predicts {self._used} of {self._measured} frames' rotations: mounting {origin}, offset "
            f"{1e3 * found.offset_s:.0f} ± {1e3 * sigmas[6]:.0f} ms, bias {bias:.2f}°/s"
        )
        return notes

    def _fit(self, gyroscope: Gyroscope) -> None:
        """Calibrate by all intervals, and compute the last errors again."""
        begins_ns, ends_ns, R_begin_end = self._turns_measured()
        self._calibration = calibrate(gyroscope, begins_ns, ends_ns, R_begin_end)
        self._of_body = None
        count = len(self._errors)
        R_turned, _, _ = self._calibration.turns(gyroscope, begins_ns[-count:], ends_ns[-count:])
        self._errors.clear()
        self._errors.extend(
            angle_between(turned, measured)
            for turned, measured in zip(R_turned, R_begin_end[-count:], strict=True)
        )

    def _turns_measured(self) -> tuple[Stamps, Stamps, Array]:
        """Return the (M,) times before and after, and the (M, 3, 3) rotations between, of the last frames."""
        begins_ns, ends_ns = (np.array([one[k] for one in self._intervals], np.int64) for k in (0, 1))
        return begins_ns, ends_ns, np.array([one[2] for one in self._intervals])

    def _turn(self, begin_ns: int, end_ns: int) -> tuple[Array, float] | None:
        """Return the gyroscope's rotation and its standard deviation by the calibration alone."""
        if self._gyroscope is None or self._calibration is None:
            return None
        if (begin_ns, end_ns) not in self._turns:
            R, J, known = self._calibration.turns(
                self._gyroscope, np.array([begin_ns], np.int64), np.array([end_ns], np.int64)
            )
            variance = float(np.trace(J[0] @ self._calibration.covariance @ J[0].T)) / 3.0
            self._turns[begin_ns, end_ns] = (R[0], math.sqrt(variance)) if known[0] else None
        return self._turns[begin_ns, end_ns]

    def _is_better(self, R: Array, sigma_rad: float) -> bool:
        """Return whether a rotation of the gyroscope is more certain than constant velocity."""
        if len(self._errors_without) < FEWEST_ERRORS:  # it may just have begun to turn
            return sigma_rad < angle_of(R) / math.sqrt(3.0)
        own = float(np.median(self._errors)) / MEDIAN_LENGTH
        without = float(np.median(self._errors_without)) / MEDIAN_LENGTH
        return math.hypot(sigma_rad, own) < without


class WithMotionPrior:
    """Odometry that predicts the motion by ``_prior``: a :class:`mapper.odometry.base.GyroscopeUser`."""

    _prior: MotionPrior

    def gyroscope_notes(self) -> Sequence[str]:
        """Return how the gyroscope was used, if the log has one."""
        return self._prior.notes()

    def gyroscope_calibration(self) -> GyroscopeCalibration | None:
        """Return the gyroscope's calibration, if the log has one that was of use."""
        return self._prior.calibration

    def begin_calibrated(self, calibration: GyroscopeCalibration, frames: int) -> None:
        """Begin with the gyroscope's calibration by that many first frames."""
        self._prior.begin_calibrated(calibration, frames)
