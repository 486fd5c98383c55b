"""Velocity during a sweep, from how the sweep lies on the surfaces of the last keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.deskew import Twist, deskewed
from mapper.core.frames import Scan
from mapper.core.geometry import Array, Transform, apply, exp, inverse
from mapper.odometry.scans.scan_fit import ScanKeyframe

_POINTS = 3000
_ROUNDS = 10
_WIDE_ROUNDS, _WIDE = 4, 3.0  # the first rounds take pairs so many times as far apart
_FEWEST_PAIRS = 60
_KERNEL = 3.0  # Cauchy's, in median distances from the surfaces
_ALIKE = 10.0  # points whose distances err alike: their surfaces' normals are fitted to so many neighbours
_RANGE_VOXELS = 16.0  # median distance of points, as chosen in surroundings.py
_SETTLED = 0.02  # of a voxel: displacement of the sweep's first points by the last step


@dataclass(frozen=True, slots=True, eq=False)
class SweepMotion:
    """Motion of the body during one sweep.

    Attributes:
        twist: Velocity in the middle of the sweep.
        covariance: (6, 6) of the velocity, rotation (rad/s)² before translation (m/s)².
        T_world_middle: (4, 4) pose of the body in the middle of the sweep.
    """

    twist: Twist
    covariance: Array
    T_world_middle: Transform


def sweep_motion(
    keyframes: Sequence[ScanKeyframe],
    sweep: Scan,
    T_world_middle: Transform,
    prior: Twist,
    prior_covariance: Array,
    *,
    start: Twist,
    max_pair_distance_m: float,
) -> SweepMotion | None:
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
    expected = _vector(prior)
    velocity, T_world_scan = _vector(start), T_world_middle
    prior_information = np.linalg.inv(prior_covariance)
    voxel_m = keyframes[0].deskewed.prepared.voxel_m
    information = np.zeros((12, 12))
    for round_ in range(_ROUNDS):
        points = deskewed(part, _twist(velocity)).points_body.astype(np.float64)
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
        scale_m = max(1.4826 * float(np.median(np.abs(residuals_m))), 0.02 * voxel_m)
        weights = 1.0 / (1.0 + (residuals_m / (_KERNEL * scale_m)) ** 2)
        weights /= _ALIKE * len(keyframes) * scale_m**2
        information = np.einsum("ni,n,nj->ij", rows, weights, rows)
        gradient = rows.T @ (weights * residuals_m)
        information[6:, 6:] += prior_information
        gradient[6:] += prior_information @ (velocity - expected)
        information[:6, :6] += 1e-6 * np.eye(6)
        step = -np.linalg.solve(information, gradient)
        T_world_scan = T_world_scan @ exp(step[:3], step[3:6])
        velocity = velocity + step[6:]
        moved_m = half_s * float(np.linalg.norm(step[6:9])) * _RANGE_VOXELS * voxel_m
        if round_ >= _WIDE_ROUNDS and moved_m < _SETTLED * voxel_m:
            break
    covariance: Array = np.linalg.inv(information)[6:, 6:].astype(np.float64)
    return SweepMotion(_twist(velocity), covariance, T_world_scan)


def _vector(twist: Twist) -> Array:
    return np.concatenate([twist.rotation_radps, twist.translation_mps])


def _twist(velocity: Array) -> Twist:
    return Twist(velocity[:3], velocity[3:])
