"""Calibration of a gyroscope by the rotations that an odometry measures: mounting, bias, clock and unit."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, rotation_exp
from mapper.core.running_median import MEDIAN_LENGTH
from mapper.core.timebase import GAP_INTERVALS, NS_PER_S, Stamps
from mapper.core.units import unit_of_gravity
from mapper.sensing.gyroscope import Gyroscope
from mapper.sensing.inertial import InertialReadings
from mapper.sources.base import Log

_STATED_RAD, _UNSTATED_RAD = 0.1, 2.0  # a mounting in tf is right to some degrees, or wrong altogether
_BIAS_RADPS, _OFFSET_S = 0.02, 0.05  # of units without calibration, and of unsynchronised clocks
_TRIED_OFFSETS_S = 0.025 * np.arange(-10, 11)
_FAR_OFFSETS_S, _FEWEST_TURNS, _LEAST_CORRELATION = 0.05 * np.arange(-200, 201), 20, 0.9
"""Offsets that are only told, and turns and correlation of speeds that tell them."""
_ITERATIONS = 8
_KERNEL = 2.4  # Cauchy's, in standard deviations
_LEAST_SIGMA_RAD = 1e-4
DEGREES = pi / 180.0
_SAME_UNIT = 1.25  # ratio of the turns of two units that are one
_LEFT_HANDED_COST = 0.5  # of that of right-handed axes, below which they are left-handed
CERTAIN_RAD = 0.05  # standard deviation of a mounting that is known
_CLEAR_RAD = 0.02  # smaller turns do not show the unit
_FASTEST_RADPS = 8.0  # no sensor turns faster for half of a log: the unit is °/s


@dataclass(frozen=True, slots=True, eq=False)
class GyroscopeCalibration:
    """How a gyroscope measures the body's rotation.

    Attributes:
        R_body_imu: (3, 3) mounting.
        bias: (3,) of the readings, after they are multiplied by ``scale``, rad/s.
        offset_s: Added to the frames' stamps it gives the readings'.
        scale: Factor to rad/s; negative where the unit's axes are left-handed, for their mirror image is a
            rotation of the opposite velocity.
        covariance: (7, 7) of small rotations of the mounting, bias and offset.
        ratio: Turns of the body by those of the readings, before scaling; 1 if the unit is as stated.
    """

    R_body_imu: Array
    bias: Array
    offset_s: float
    scale: float
    covariance: Array
    ratio: float = 1.0

    @property
    def is_mounting_known(self) -> bool:
        """Whether the mounting is certain about every axis."""
        return bool(np.sqrt(np.diag(self.covariance)[:3].max()) <= CERTAIN_RAD)

    def turns(
        self, gyroscope: Gyroscope, begins_ns: Stamps, ends_ns: Stamps
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return (M, 3, 3) rotations of the body, (M, 3, 7) what they change with, and (M,) which are known.

        Args:
            gyroscope: The readings.
            begins_ns: (M,) times of frames.
            ends_ns: (M,) later ones.
        """
        shift_ns = round(self.offset_s * NS_PER_S)
        begins_imu_ns, ends_imu_ns = begins_ns + shift_ns, ends_ns + shift_ns
        G, known = gyroscope.rotations(begins_imu_ns, ends_imu_ns, self.bias, self.scale)
        R = self.R_body_imu
        R_begin_end = R @ G @ R.T
        seconds = (ends_ns - begins_ns) / NS_PER_S
        first, last = (
            self.scale * gyroscope.rates_at(at_ns) - self.bias for at_ns in (begins_imu_ns, ends_imu_ns)
        )
        by_time = last - np.einsum("mji,mj->mi", G, first)
        J = np.empty((len(seconds), 3, 7))
        J[:, :, :3] = R_begin_end.transpose(0, 2, 1) - np.eye(3)
        J[:, :, 3:6] = -0.5 * seconds[:, None, None] * (R @ (np.eye(3) + G.transpose(0, 2, 1)))
        J[:, :, 6] = by_time @ R.T
        return R_begin_end, J, known

    def applied_to(self, gyroscope: Gyroscope) -> Gyroscope:
        """Return the readings of the body: in its axes and the frames' clock, without the bias."""
        return replace(
            gyroscope,
            stamps_ns=gyroscope.stamps_ns - round(self.offset_s * NS_PER_S),
            rates_radps=(self.scale * gyroscope.rates_radps - self.bias) @ self.R_body_imu.T,
            R_body_imu=np.eye(3),
            is_of_body=True,
        )


def with_body_rates(log: Log, calibration: GyroscopeCalibration | None) -> Log:
    """Return a log with the readings of its gyroscope calibrated; the log itself without one of both."""
    if calibration is None or log.gyroscope is None or log.gyroscope.is_of_body:
        return log
    return replace(log, gyroscope=calibration.applied_to(log.gyroscope))


def body_readings(log: Log, calibration: GyroscopeCalibration) -> InertialReadings | None:
    """Return a log's angular velocities and accelerations of the body; None where they cannot be told.

    Accelerations have to be as long as gravity in m/s² or g, and the mounting certain. They are interpolated
    at the times of the angular velocities, not across gaps, and moved to the body's origin where the log
    states the unit's place.
    """
    gyroscope, felt = log.gyroscope, log.accelerations
    if gyroscope is None or felt is None or not calibration.is_mounting_known:
        return None
    unit = unit_of_gravity(float(np.median(np.linalg.norm(felt.acceleration_mps2, axis=1))))
    turned = calibration.applied_to(gyroscope)
    R_body_felt = mounting_of_accelerations(log, calibration)
    stamps_ns = felt.stamps_ns - round(calibration.offset_s * NS_PER_S)
    if unit is None or len(stamps_ns) < 2:
        return None
    intervals_ns = np.diff(stamps_ns)
    after = np.searchsorted(stamps_ns, turned.stamps_ns).clip(1, len(stamps_ns) - 1)
    longest_ns = max(turned.gap_ns, GAP_INTERVALS * float(np.median(intervals_ns)))
    inside = (turned.stamps_ns >= stamps_ns[0]) & (turned.stamps_ns <= stamps_ns[-1])
    inside &= intervals_ns[after - 1] <= longest_ns
    if inside.sum() < 2:
        return None
    at_ns = turned.stamps_ns[inside]
    felt_body = unit * felt.acceleration_mps2 @ R_body_felt.T
    accelerations = np.column_stack([np.interp(at_ns, stamps_ns, column) for column in felt_body.T])
    readings = InertialReadings(at_ns, turned.rates_radps[inside], accelerations, turned.gap_ns)
    return readings if felt.place_body is None else readings.moved_from(felt.place_body)


def mounting_of_accelerations(log: Log, calibration: GyroscopeCalibration) -> Array:
    """Return the mounting (3, 3) of a log's accelerations, if their axes are those of its gyroscope."""
    gyroscope, felt = log.gyroscope, log.accelerations
    assert gyroscope is not None
    assert felt is not None
    if felt.are_axes_stated and gyroscope.R_body_imu is not None:
        return calibration.R_body_imu @ gyroscope.R_body_imu.T
    return calibration.R_body_imu


def uncalibrated(gyroscope: Gyroscope) -> GyroscopeCalibration:
    """Return what is known before the first frame: the unit, and the mounting if the log states it.

    Of a wrong unit the first sweeps are bent so much that no frame after them measures the right one.
    """
    R = gyroscope.R_body_imu
    is_in_degrees = np.median(np.linalg.norm(gyroscope.rates_radps, axis=1)) > _FASTEST_RADPS
    return GyroscopeCalibration(
        np.eye(3) if R is None else R,
        np.zeros(3),
        0.0,
        DEGREES if is_in_degrees else 1.0,
        np.diag(_prior_sigmas(gyroscope) ** 2),
    )


def calibrate(
    gyroscope: Gyroscope, begins_ns: Stamps, ends_ns: Stamps, R_begin_end: Array
) -> GyroscopeCalibration:
    """Return the calibration under which the readings agree best with measured rotations of the body.

    Least squares of the rotations' differences, as LI-Init (Zhu et al. 2022) of angular velocities, under
    Cauchy's kernel and weak priors: so what the motion does not show keeps its prior variance. The clocks'
    offset begins at the best of a grid, the mounting at the closed form (Kabsch 1976).

    Args:
        gyroscope: The readings.
        begins_ns: (M,) times of frames.
        ends_ns: (M,) times of the frames after them.
        R_begin_end: (M, 3, 3) measured rotations of the body between them.
    """
    first = uncalibrated(gyroscope)
    _, _, known = first.turns(gyroscope, begins_ns, ends_ns)
    begins_ns, ends_ns, R_begin_end = begins_ns[known], ends_ns[known], R_begin_end[known]
    if not len(begins_ns):
        return first
    measured = _logs(R_begin_end)
    clear = np.linalg.norm(measured, axis=1) > _CLEAR_RAD
    ratio = 1.0
    if clear.sum() >= 5:
        # Of velocities in degrees the integral winds many times around; the mean reading does not.
        ratio = _speed_ratio(gyroscope, begins_ns[clear], ends_ns[clear], measured[clear])
    unit = DEGREES if 1.0 / _SAME_UNIT < ratio / DEGREES < _SAME_UNIT else 1.0
    best: tuple[float, GyroscopeCalibration] | None = None
    for scale in (unit, -unit):
        _, offset_s, R = min(
            (
                _closed_form(gyroscope, scale, begins_ns, ends_ns, measured, offset_s)
                for offset_s in _TRIED_OFFSETS_S.tolist()
            ),
            key=lambda one: one[0],
        )
        begun = GyroscopeCalibration(R, np.zeros(3), offset_s, scale, first.covariance, ratio)
        found = _refine(begun, gyroscope, begins_ns, ends_ns, R_begin_end)
        if best is None or found[0] < _LEFT_HANDED_COST * best[0]:
            best = found
    assert best is not None
    return best[1]


def _refine(
    calibration: GyroscopeCalibration, gyroscope: Gyroscope, begins_ns: Stamps, ends_ns: Stamps, R: Array
) -> tuple[float, GyroscopeCalibration]:
    """Return the sum of the residuals' lengths and the calibration, by Gauss–Newton."""
    sigmas = _prior_sigmas(gyroscope)
    R_stated = gyroscope.R_body_imu
    found, cost = calibration, np.inf
    for _ in range(_ITERATIONS):
        R_turned, J, known = found.turns(gyroscope, begins_ns, ends_ns)
        residuals = _logs(R_turned.transpose(0, 2, 1) @ R)
        residuals[~known], J[~known] = 0.0, 0.0
        lengths = np.linalg.norm(residuals, axis=1)
        sigma = max(
            float(np.median(lengths[known])) / MEDIAN_LENGTH if known.any() else 0.0, _LEAST_SIGMA_RAD
        )
        weights = 1.0 / (1.0 + (lengths / (_KERNEL * sigma)) ** 2) / sigma**2
        tilt = np.zeros(3) if R_stated is None else _logs((R_stated @ found.R_body_imu.T)[None])[0]
        off = np.concatenate([tilt, -found.bias, [-found.offset_s]])
        information = np.einsum("mia,m,mib->ab", J, weights, J) + np.diag(sigmas**-2.0)
        gradient = np.einsum("mia,m,mi->a", J, weights, residuals) + off / sigmas**2
        step = np.linalg.solve(information, gradient)
        cost = float(lengths.sum())
        found = GyroscopeCalibration(
            rotation_exp(step[:3]) @ found.R_body_imu,
            found.bias + step[3:6],
            found.offset_s + float(step[6]),
            found.scale,
            np.linalg.inv(information),
            found.ratio,
        )
    return cost, found


def _closed_form(
    gyroscope: Gyroscope, scale: float, begins_ns: Stamps, ends_ns: Stamps, measured: Array, offset_s: float
) -> tuple[float, float, Array]:
    """Return the sum of the residuals' lengths, the offset and the mounting by rotation vectors."""
    shift_ns = round(offset_s * NS_PER_S)
    R_turned, known = gyroscope.rotations(begins_ns + shift_ns, ends_ns + shift_ns, np.zeros(3), scale)
    turned = _logs(R_turned)
    expected = np.eye(3) if gyroscope.R_body_imu is None else gyroscope.R_body_imu
    sigmas = _prior_sigmas(gyroscope)
    prior = (_LEAST_SIGMA_RAD / sigmas[0]) ** 2 * expected
    U, _, Vt = np.linalg.svd(measured[known].T @ turned[known] + prior)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    lengths = np.linalg.norm(measured - turned @ R.T, axis=1)
    lengths[~known] = np.linalg.norm(measured[~known], axis=1)
    return float(lengths.sum()), offset_s, R


def _speed_ratio(gyroscope: Gyroscope, begins_ns: Stamps, ends_ns: Stamps, measured: Array) -> float:
    turned = _turns(gyroscope)(begins_ns, ends_ns)
    return float(np.median(np.linalg.norm(measured, axis=1) / np.maximum(turned, 1e-9)))


def _turns(gyroscope: Gyroscope) -> Callable[[Stamps, Stamps], Array]:
    """Return the function of the (M,) angles turned between pairs of times; NaN beyond the readings."""
    first_ns, turned_rad = gyroscope.stamps_ns[0], gyroscope.turned_rad()
    since_s = (gyroscope.stamps_ns - first_ns) / NS_PER_S

    def turned_until(times_ns: Stamps) -> Array:
        at_s = (times_ns - first_ns) / NS_PER_S
        return np.asarray(np.interp(at_s, since_s, turned_rad, left=np.nan, right=np.nan), np.float64)

    return lambda begins_ns, ends_ns: turned_until(ends_ns) - turned_until(begins_ns)


def offset_by_speeds(
    gyroscope: Gyroscope, begins_ns: Stamps, ends_ns: Stamps, R_begin_end: Array
) -> float | None:
    """Return the seconds added to frames' stamps at which their turns are as fast as the readings say.

    Whatever mounting and unit are, within 10 s; None where at no offset they are.

    Args:
        gyroscope: The readings.
        begins_ns: (M,) times of frames.
        ends_ns: (M,) times of the frames after them.
        R_begin_end: (M, 3, 3) measured rotations of the body between them.
    """
    seconds = (ends_ns - begins_ns) / NS_PER_S
    measured = np.linalg.norm(_logs(R_begin_end), axis=1) / seconds
    turns, best = _turns(gyroscope), (_LEAST_CORRELATION, None)
    for offset_s in _FAR_OFFSETS_S.tolist():
        shift_ns = round(offset_s * NS_PER_S)
        turned = turns(begins_ns + shift_ns, ends_ns + shift_ns) / seconds
        known = np.isfinite(turned)
        if known.sum() >= _FEWEST_TURNS and turned[known].std() > 0.0 and measured[known].std() > 0.0:
            best = max(best, (float(np.corrcoef(turned[known], measured[known])[0, 1]), offset_s))
    return best[1]


def _prior_sigmas(gyroscope: Gyroscope) -> Array:
    mounting = _UNSTATED_RAD if gyroscope.R_body_imu is None else _STATED_RAD
    return np.array([mounting] * 3 + [_BIAS_RADPS] * 3 + [_OFFSET_S])


def _logs(R: Array) -> Array:
    """Return the (M, 3) rotation vectors of (M, 3, 3) rotations."""
    from mapper.sensing.gyroscope_kernels import rotation_vectors  # numba takes long to import

    vectors: Array = rotation_vectors(np.ascontiguousarray(R))
    return vectors
