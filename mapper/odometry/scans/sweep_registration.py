"""Registration of a sweep: its pose, and the velocity during it, from the surfaces of the last keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.deskew import SampledMotion, Twist, deskewed
from mapper.core.frames import Scan
from mapper.core.geometry import Array, Transform, apply, exp, inverse
from mapper.core.linear import gram
from mapper.core.running_median import SIGMAS_PER_MAD
from mapper.odometry.scans.config import ScanOdometryConfig
from mapper.odometry.scans.pose_candidate import PoseCandidate
from mapper.odometry.scans.pose_search import KnownPath, PoseSearch
from mapper.odometry.scans.scan_fit import ScanKeyframe
from mapper.odometry.scans.scan_matcher import DeskewedScan, ScanMatcher
from mapper.odometry.scans.scan_observation import ScanObservation

_POINTS = 3000
_FIT_ROUNDS = 10
_WIDE_ROUNDS, _WIDE = 4, 3.0  # the first rounds take pairs this multiple of the distance apart
_FEWEST_PAIRS = 60
_KERNEL = 3.0  # Cauchy's, in median distances from the surfaces
_ALIKE = 10.0  # points whose distances err alike: neighbours to which a normal is fitted
_RANGE_VOXELS = 16.0  # median distance of points, as chosen in adapted_lengths.py
_FITTED = 0.02  # of a voxel: displacement of the sweep's first points by the last step


_NEGLIGIBLE, _SETTLED = 0.2, 0.05
"""Displacement of a sweep's outer points, in voxels, by a change of the velocity: less is not searched for,
less ends the search for the velocity."""
_ROUNDS = 3
_WIDENED = 2.0  # expected changes of the velocity, for turns begin and end suddenly
_CHANGED = 0.25  # of what the velocity may change, where it is not measured


@dataclass(frozen=True, slots=True, eq=False)
class PlacedScan:
    """A scan with its pose.

    Attributes:
        deskewed: The scan.
        found: Its pose in the middle of the sweep.
        twist: Velocity then, if it was measured; None is the mean one since the scan before.
        velocity_covariance: (6, 6) of the velocity, (rad/s)² and (m/s)².
        sweep: Motion about the middle of the sweep by a gyroscope or wheels; None if none knows it.
    """

    deskewed: DeskewedScan
    found: PoseCandidate
    twist: Twist | None
    velocity_covariance: Array
    sweep: SampledMotion | None = None


class SweepRegistration:
    """Registration of scans that are taken point by point while the sensor moves."""

    def __init__(self, config: ScanOdometryConfig, matcher: ScanMatcher, search: PoseSearch) -> None:
        self._config = config
        self._matcher = matcher
        self._search = search

    def register(self, observation: ScanObservation, path: KnownPath) -> PlacedScan | None:
        """Return where a scan fits best; None if next to nothing agrees with any pose.

        Where the velocity may have changed enough to displace the points of the sweep, it is found
        together with the pose; not before the errors of a few predictions are known, as two scans, each with
        a velocity of its own, fit under wrong ones, too. Nor where a gyroscope knows the rotation.
        """
        motion, time_ns = path.motion, observation.middle_ns
        measured = motion.sweep(time_ns, observation.half_s)
        if measured is not None:
            return self._by_gyroscope(observation, path, measured)
        sigmas = motion.velocity_sigmas(time_ns)
        if motion.is_by_wheels(time_ns):
            return self._at_velocity(observation, path, np.diag((_CHANGED * sigmas) ** 2))
        if motion.spread(time_ns) is None or observation.displacement(float(sigmas[0])) <= _NEGLIGIBLE:
            return self._at_velocity(observation, path, np.diag((_CHANGED * sigmas) ** 2))
        placed = self._with_velocity(observation, path)
        if placed is None:
            placed = self._at_velocity(observation, path, None)
        return placed

    def _by_gyroscope(
        self, observation: ScanObservation, path: KnownPath, measured: SampledMotion
    ) -> PlacedScan | None:
        """Register a scan, deskewed by the gyroscope and the velocity, until this is that of its pose."""
        motion, time_ns = path.motion, observation.middle_ns
        T_world_guess, placed = None, None
        for _ in range(_ROUNDS):
            deskewed = observation.deskew(measured)
            found = self._search.find(deskewed, path, time_ns, T_world_guess)
            if found is None:
                break
            again = motion.sweep(time_ns, observation.half_s, found.T_world_middle)
            assert again is not None
            sigmas = np.concatenate([[motion.prior.spread_radps()] * 3, motion.velocity_sigmas(time_ns)[3:]])
            sigmas[3:] *= _CHANGED
            placed = PlacedScan(deskewed, found, None, np.diag(sigmas**2), again)
            change_mps = np.linalg.norm(again.translation_mps - measured.translation_mps)
            if change_mps * observation.half_s < _SETTLED * observation.voxel_m:
                break
            measured, T_world_guess = again, found.T_world_middle
        return placed

    def _at_velocity(
        self, observation: ScanObservation, path: KnownPath, covariance: Array | None
    ) -> PlacedScan | None:
        """Register a scan that is deskewed by the velocity until then; None is its expected covariance."""
        rolling = path.motion.rolling(observation.middle_ns, observation.half_s)
        deskewed = observation.deskew(rolling or path.motion.twist)
        found = self._search.find(deskewed, path, observation.middle_ns)
        if found is None:
            return None
        if covariance is None:
            covariance = path.motion.velocity(observation.middle_ns, found.T_world_middle)[1]
        return PlacedScan(deskewed, found, None, covariance, rolling)

    def _with_velocity(self, observation: ScanObservation, path: KnownPath) -> PlacedScan | None:
        """Find velocity and pose in turn: the sweep on the keyframes' surfaces, the scan in the map."""
        motion, time_ns = path.motion, observation.middle_ns
        T_world_middle = motion.predicted(time_ns)
        matched = self._matcher.match(observation.deskew(motion.twist), T_world_middle, reach="near")
        T_world_middle = T_world_middle if matched is None else matched
        twist, placed = motion.twist, None
        for _ in range(_ROUNDS):
            expected, covariance = motion.velocity(time_ns, T_world_middle)
            sweep = fit_sweep_motion(
                path.keyframes,
                observation.sweep(observation.middle_s),
                T_world_middle,
                expected,
                _WIDENED**2 * covariance,
                start=twist,
                max_pair_distance_m=self._config.max_pair_distance_m,
            )
            if sweep is None:
                break
            change, twist = sweep.twist.rotation_radps - twist.rotation_radps, sweep.twist
            deskewed = observation.deskew(twist)
            found = self._search.find(deskewed, path, time_ns, sweep.T_world_middle)
            if found is None:
                return None
            T_world_middle = found.T_world_middle
            accelerated = motion.acceleration(time_ns, T_world_middle, twist)
            bent = accelerated * observation.half_s / 3.0
            covariance = sweep.covariance + np.diag([*(change**2 + bent**2), 0.0, 0.0, 0.0])
            placed = PlacedScan(deskewed, found, twist, covariance)
            if observation.displacement(float(np.linalg.norm(change))) < _SETTLED:
                break
        return placed


@dataclass(frozen=True, slots=True, eq=False)
class FittedMotion:
    """Motion of the body during one sweep.

    Attributes:
        twist: Velocity in the middle of the sweep.
        covariance: (6, 6) of the velocity, rotation (rad/s)² before translation (m/s)².
        T_world_middle: (4, 4) pose of the body in the middle of the sweep.
    """

    twist: Twist
    covariance: Array
    T_world_middle: Transform


def fit_sweep_motion(
    keyframes: Sequence[ScanKeyframe],
    sweep: Scan,
    T_world_middle: Transform,
    prior: Twist,
    prior_covariance: Array,
    *,
    start: Twist,
    max_pair_distance_m: float,
) -> FittedMotion | None:
    """Return the pose and the velocity under which a sweep fits the keyframes' surfaces; None with few pairs.

    Twelve unknowns, two poses as in CT-ICP (Dellenbach et al. 2022): the pose in the middle and the
    constant velocity about it. A point measured τ after the middle moves by the step of the pose, and by τ
    times the step of the velocity, so a row of the normal equations is [J, τJ].

    Args:
        keyframes: With the surfaces.
        sweep: Thinned points with times from the middle of the sweep.
        T_world_middle: (4, 4) guess.
        prior: Expected velocity.
        prior_covariance: (6, 6) of it, rotation (rad/s)² before translation (m/s)².
        start: Velocity to begin with.
        max_pair_distance_m: Largest distance between the points of a pair.
    """
    assert sweep.times_s is not None
    step_of = max(1, -(-len(sweep.points_body) // _POINTS))
    part = Scan(sweep.stamp_ns, sweep.points_body[::step_of], times_s=sweep.times_s[::step_of])
    times_s = sweep.times_s[::step_of].astype(np.float64)
    half_s = float(np.abs(times_s).max())
    expected = prior.vector
    velocity, T_world_scan = start.vector, T_world_middle
    prior_information = np.linalg.inv(prior_covariance)
    voxel_m = keyframes[0].deskewed.prepared.voxel_m
    information = np.zeros((12, 12))
    for round_ in range(_FIT_ROUNDS):
        points = deskewed(part, Twist.of(velocity)).points_body.astype(np.float64)
        reach_m = max_pair_distance_m * (_WIDE if round_ < _WIDE_ROUNDS else 1.0)
        parts, distances = [], []
        for keyframe in keyframes:
            target = keyframe.deskewed.prepared
            T_key_scan = inverse(keyframe.T_world_middle) @ T_world_scan
            points_key = apply(T_key_scan, points)
            indices, distances_m = target.nearest(points_key)
            near = np.flatnonzero((distances_m <= reach_m) & target.normals[indices].any(axis=1))
            normals_key = target.normals[indices[near]]
            off = points_key[near] - target.points[indices[near]]
            distances.append(np.einsum("ni,ni->n", normals_key, off))
            normals = normals_key @ T_key_scan[:3, :3]
            rows = np.hstack([np.cross(points[near], normals), normals])
            parts.append(np.hstack([rows, times_s[near, None] * rows]))
        rows, residuals_m = np.concatenate(parts), np.concatenate(distances)
        if len(rows) < _FEWEST_PAIRS:
            return None
        scale_m = max(SIGMAS_PER_MAD * float(np.median(np.abs(residuals_m))), 0.02 * voxel_m)
        weights = 1.0 / (1.0 + (residuals_m / (_KERNEL * scale_m)) ** 2)
        weights /= _ALIKE * len(keyframes) * scale_m**2
        information = gram(rows, weights[:, None] * rows)
        gradient = rows.T @ (weights * residuals_m)
        information[6:, 6:] += prior_information
        gradient[6:] += prior_information @ (velocity - expected)
        information[:6, :6] += 1e-6 * np.eye(6)
        step = -np.linalg.solve(information, gradient)
        T_world_scan = T_world_scan @ exp(step[:3], step[3:6])
        velocity = velocity + step[6:]
        moved_m = half_s * float(np.linalg.norm(step[6:9])) * _RANGE_VOXELS * voxel_m
        if round_ >= _WIDE_ROUNDS and moved_m < _FITTED * voxel_m:
            break
    covariance: Array = np.linalg.inv(information)[6:, 6:].astype(np.float64)
    return FittedMotion(Twist.of(velocity), covariance, T_world_scan)
