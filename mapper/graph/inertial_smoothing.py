"""Inertial smoothing: poses by an odometry and preintegrated IMU readings (Forster et al. 2017)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from mapper.core.errors import GraphError
from mapper.core.geometry import Array, Transform, adjoint, inverse, length_and_angle, log, transform
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.core.units import GRAVITY_MPS2
from mapper.graph.gtsam_factors import Kernel, anchor, between, pose3
from mapper.graph.least_squares import Effort, problem_of, solve
from mapper.graph.model import BetweenFactor
from mapper.sensing.inertial import InertialReadings

if TYPE_CHECKING:
    import gtsam

_EFFORT = Effort(max_iterations=50, relative_error=1e-6)
_GYROSCOPE_BIAS_RADPS, _ACCELEROMETER_BIAS_MPS2 = 0.005, 0.3
"""Prior standard deviations: of the calibrated gyroscope, and of an accelerometer that nothing calibrates."""
_GYROSCOPE_WALK, _ACCELEROMETER_WALK = 3e-4, 1e-3
"""Random walks of the biases, rad/s/√s and m/s²/√s, as of consumer units (Forster et al. 2017, §VIII)."""
_INTEGRATION_M2 = 1e-6
_KERNEL = Kernel("huber", 3.0)
"""Of odometry's factors: where surfaces show a motion that is not, the readings contradict it."""
_CONTRADICTION_SIGMAS, _CONTRADICTION_M, _CONTRADICTION_RAD = 6.0, 0.1, 0.1
"""Far beyond any error but that of a wrong pose."""
_VELOCITY_S = 0.5
"""Before and after a pose, in which its velocity to begin with is measured."""


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedPath:
    """Poses at some times, smoothed with inertial readings.

    Attributes:
        T_world_body: (N, 4, 4).
        velocity_sigmas_mps: (N,) standard deviation of the velocity in its worst direction.
        variance_factor: Mean square of the residuals, in their variances: 1 where noise explains them.
    """

    T_world_body: Array
    velocity_sigmas_mps: Array
    variance_factor: float
    _marginals: Any = field(repr=False)

    def covariance(self, i: int, j: int) -> Array:
        """Return the (6, 6) covariance of T_i_j in the tangent of j, with the variance factor."""
        joint = self._marginals.jointMarginalCovariance([i, j])
        to_j = adjoint(inverse(self.T_world_body[j]) @ self.T_world_body[i])
        J = np.hstack([-to_j, np.eye(6)])
        blocks = np.block([[joint.at(a, b) for b in (i, j)] for a in (i, j)])
        return np.asarray(self.variance_factor * J @ blocks @ J.T, np.float64)

    def contradicts(self, factor: BetweenFactor) -> bool:
        """Return whether a factor between two of the times is far off the path, and both are that sure."""
        i, j = factor.i, factor.j
        miss = inverse(factor.T_i_j) @ inverse(self.T_world_body[i]) @ self.T_world_body[j]
        distance_m, angle_rad = length_and_angle(miss)
        if distance_m <= _CONTRADICTION_M and angle_rad <= _CONTRADICTION_RAD:
            return False
        off = np.concatenate(log(miss))
        chi2 = min(off @ factor.information @ off, off @ np.linalg.solve(self.covariance(i, j), off))
        return bool(chi2 > _CONTRADICTION_SIGMAS**2)


def smooth_path(
    stamps_ns: Stamps,
    poses: Mapping[int, Transform],
    part_of: Mapping[int, int],
    factors: Sequence[BetweenFactor],
    readings: InertialReadings,
) -> SmoothedPath:
    """Return the poses, velocities, biases and gravity that odometry and inertial readings explain best.

    Consecutive times are connected by preintegrated readings, under a gravity whose direction is estimated,
    so the world need not be level. The first pose keeps its place.

    Args:
        stamps_ns: (N,) increasing times; the readings cover them without gaps.
        poses: T_world_body to begin with at some of the times, the first among them, by their indices, and
            from N on of other nodes.
        part_of: Number of the part of the path of each of these poses; parts have worlds of their own.
        factors: The odometry's measurements, between these indices.
        readings: Readings of the body.

    Raises:
        GraphError: The readings do not determine the path.
    """
    import gtsam

    largest = Counter(part_of[k] for k in poses if k < len(stamps_ns)).most_common(1)[0][0]
    placed = [k for k in sorted(poses) if k < len(stamps_ns) and part_of[k] == largest]
    readings = readings.at_body(stamps_ns[placed], np.array([poses[k] for k in placed]))
    parameters = _parameters(readings)
    segments = [
        _preintegrated(readings, begin_ns, end_ns, parameters)
        for begin_ns, end_ns in pairwise(stamps_ns.tolist())
    ]
    up = _up(stamps_ns, poses, readings)
    guess, velocities = _predict((stamps_ns - stamps_ns[0]) / NS_PER_S, poses, part_of, segments, up)
    times = range(len(stamps_ns))
    velocity, bias = ([gtsam.symbol(letter, k) for k in times] for letter in "vb")
    gravity = gtsam.symbol("g", 0)
    start = gtsam.Values()
    for k in times:
        start.insert(velocity[k], velocities[k])
        start.insert(bias[k], gtsam.imuBias.ConstantBias())
    for k, T in guess.items():
        start.insert(k, pose3(T))
    start.insert(gravity, gtsam.Unit3(-up))
    bias_sigmas = np.repeat([_ACCELEROMETER_BIAS_MPS2, _GYROSCOPE_BIAS_RADPS], 3)
    at_rest, noise = gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Diagonal.Sigmas(bias_sigmas)
    terms: list[gtsam.NonlinearFactor] = [
        anchor(0, guess[0]),
        gtsam.PriorFactorConstantBias(bias[0], at_rest, noise),
        *(between(factor, kernel=_KERNEL) for factor in factors),
    ]
    for k, segment in enumerate(segments):
        keys = k, velocity[k], k + 1, velocity[k + 1], bias[k], bias[k + 1], gravity
        terms.append(gtsam.CombinedImuFactorWithGravityDirection(*keys, segment, GRAVITY_MPS2))
    values, _ = solve(terms, (), start, effort=_EFFORT)
    problem = problem_of(terms)
    freedom = sum(term.dim() for term in terms) - values.dim()
    variance_factor = max(1.0, 2.0 * problem.error(values) / max(freedom, 1))
    try:
        marginals = gtsam.Marginals(problem, values)
        variances = [np.linalg.eigvalsh(marginals.marginalCovariance(velocity[k]))[-1] for k in times]
    except RuntimeError:  # GTSAM's text is long, and of its own variables
        raise GraphError(f"the inertial readings do not determine the path of {len(times)} frames") from None
    return SmoothedPath(
        T_world_body=np.array([values.atPose3(k).matrix() for k in times]),
        velocity_sigmas_mps=np.sqrt(variance_factor * np.array(variances)),
        variance_factor=variance_factor,
        _marginals=marginals,
    )


def _parameters(readings: InertialReadings) -> gtsam.PreintegrationCombinedParams:
    import gtsam

    parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_MPS2)
    parameters.setGyroscopeCovariance(readings.rate_density**2 * np.eye(3))
    parameters.setAccelerometerCovariance(readings.acceleration_density**2 * np.eye(3))
    parameters.setIntegrationCovariance(_INTEGRATION_M2 * np.eye(3))
    parameters.setBiasOmegaCovariance(_GYROSCOPE_WALK**2 * np.eye(3))
    parameters.setBiasAccCovariance(_ACCELEROMETER_WALK**2 * np.eye(3))
    return parameters


def _preintegrated(
    readings: InertialReadings, begin_ns: int, end_ns: int, parameters: gtsam.PreintegrationCombinedParams
) -> gtsam.PreintegratedCombinedMeasurements:
    """Return the readings between two times, each piece with the mean of those at its ends."""
    import gtsam

    segment = gtsam.PreintegratedCombinedMeasurements(parameters)
    rates, accelerations, seconds = readings.between(begin_ns, end_ns)
    for rate, acceleration, duration_s in zip(rates, accelerations, seconds.tolist(), strict=True):
        segment.integrateMeasurement(acceleration, rate, duration_s)
    return segment


def _up(stamps_ns: Stamps, poses: Mapping[int, Transform], readings: InertialReadings) -> Array:
    """Return the mean direction of the accelerations in the world: nothing accelerates for long."""
    felt = np.zeros(3)
    for k, (begin_ns, end_ns) in enumerate(pairwise(stamps_ns.tolist())):
        if k in poses:
            _, accelerations, seconds = readings.between(begin_ns, end_ns)
            felt += poses[k][:3, :3] @ (seconds @ accelerations)
    return np.asarray(felt / np.linalg.norm(felt), np.float64)


def _predict(
    times_s: Array,
    poses: Mapping[int, Transform],
    part_of: Mapping[int, int],
    segments: Sequence[gtsam.PreintegratedCombinedMeasurements],
    up: Array,
) -> tuple[dict[int, Transform], Array]:
    """Return poses of all times and other nodes, and (N, 3) velocities, to begin with.

    Where no pose is known, or the first one of another part is, the readings predict it.
    """
    fall_mps2 = -GRAVITY_MPS2 * up
    guess, velocities = {0: poses[0]}, np.zeros((len(times_s), 3))
    T_world_part = {part_of[0]: np.eye(4)}
    known = np.array(sorted(k for k in poses if k < len(times_s)))
    parts = np.array([part_of[k] for k in known.tolist()])
    for k in range(len(times_s)):
        if k:
            elapsed_s, segment, R = times_s[k] - times_s[k - 1], segments[k - 1], guess[k - 1][:3, :3]
            moved = velocities[k - 1] * elapsed_s + 0.5 * fall_mps2 * elapsed_s**2 + R @ segment.deltaPij()
            guess[k] = transform(R @ segment.deltaRij().matrix(), guess[k - 1][:3, 3] + moved)
            velocities[k] = velocities[k - 1] + fall_mps2 * elapsed_s + R @ segment.deltaVij()
        if k in poses:
            T_world_part.setdefault(part_of[k], guess[k] @ inverse(poses[k]))
            guess[k] = T_world_part[part_of[k]] @ poses[k]
            near = known[(parts == part_of[k]) & (np.abs(times_s[known] - times_s[k]) <= _VELOCITY_S)]
            first, last = near[0], near[-1]
            if last > first:
                way = T_world_part[part_of[k]][:3, :3] @ (poses[last][:3, 3] - poses[first][:3, 3])
                velocities[k] = way / (times_s[last] - times_s[first])
    others = {k: T_world_part[part_of[k]] @ T for k, T in poses.items() if k >= len(times_s)}
    return guess | others, velocities
