"""Factor by which pairs of sweeps have to be deskewed to fit each other best, of what their times say."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.deskew import Twist, deskewed
from mapper.core.geometry import Array, Transform, apply, exp, inverse
from mapper.core.subsampling import stride_for
from mapper.odometry.scan_to_map.scan_observation import ScanObservation
from mapper.registration.refining import plane_rows

_POINTS = 2000
_POSE_STEPS = 15
_SETTLED_VOXELS, _SETTLED_RAD = 0.02, 5e-4
_FEWEST_PAIRS = 100
_NEAR_VOXELS = 3.0
_SCALE_VOXELS, _FARTHEST_VOXELS = 0.1, 1.0
"""Distances from surfaces, above which they count little, and as much as this."""
_STEPS = (0.4, 0.1)
_FARTHEST = 4.0  # factor that is tried


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """One of two sweeps.

    Attributes:
        observation: Its thinned points, with times.
        twist: Velocity of the body during the sweep, by the poses around it.
        T_world_body: (4, 4) pose at the stamp.
    """

    observation: ScanObservation
    twist: Twist
    T_world_body: Transform


@dataclass(frozen=True, slots=True)
class SweepFactor:
    """Factor on the times of a log's sweeps.

    Attributes:
        factor: 1 where the times are right, 0 where nothing is left to deskew.
        gains: (N,) by how much each pair fits better under it than under the assumed one, of the latter.
    """

    factor: float
    gains: Array


def fits_otherwise(pairs: Sequence[tuple[Sweep, Sweep]], assumed: float) -> bool:
    """Return whether pairs of sweeps fit better half way between the factors 0 and 1 than under one of them.

    They do wherever the right factor is beyond, too.
    """
    costs = [(_cost(first, second, assumed), _cost(first, second, 0.5)) for first, second in pairs]
    return bool(np.subtract(*np.transpose(costs)).mean() > 0.0)


def sweep_factor(
    pairs: Sequence[tuple[Sweep, Sweep]], assumed: float, others: Sequence[float]
) -> SweepFactor:
    """Return the factor under which both sweeps of each pair fit best.

    Both sweeps of a pair are deskewed with the factor, as a map of sweeps that are all bent in the same way
    fits another such sweep well. If one of the other factors fits better than the assumed one, the best is
    searched from there by parabolas.

    Args:
        pairs: Of sweeps that see the same surfaces, at different velocities or from different places.
        assumed: Factor with which the poses were found.
        others: Factors that are possible too.
    """
    costs: dict[float, Array] = {}

    def cost(factor: float) -> float:
        if factor not in costs:
            costs[factor] = np.array([_cost(first, second, factor) for first, second in pairs])
        return float(costs[factor].mean())

    best = min((assumed, *others), key=cost)
    if best != assumed:
        for step in _STEPS:
            while (towards := min((best, best - step, best + step), key=cost)) != best:
                best = towards
                if abs(best) > _FARTHEST:
                    break
            below, here, above = (cost(best + side) for side in (-step, 0.0, step))
            vertex = best + 0.5 * step * (below - above) / max(below - 2.0 * here + above, 1e-9)
            best = min((best, vertex), key=cost)
    return SweepFactor(best, 1.0 - costs[best] / np.maximum(costs[assumed], 1e-9))


def _cost(first: Sweep, second: Sweep, factor: float) -> float:
    """Return how badly two sweeps fit under a factor, at their best relative pose: a mean over the points.

    Points without a partner, and those far from its surface, count alike, so that the sum does not depend on
    which points have a partner.
    """
    target = first.observation.deskew(_scaled(first.twist, factor)).prepared
    observation = second.observation
    swept = observation.sweep(observation.middle_s)
    all_points = deskewed(swept, _scaled(second.twist, factor)).points_body
    points = all_points[:: stride_for(len(all_points), _POINTS)].astype(np.float64)
    T_first_second = inverse(_middle(first, factor)) @ _middle(second, factor)
    distances_m = np.full(len(points), np.inf)
    for _ in range(_POSE_STEPS):
        indices, apart_m = target.nearest(apply(T_first_second, points))
        is_near = (apart_m <= _NEAR_VOXELS * target.voxel_m) & target.normals[indices].any(axis=1)
        near = np.flatnonzero(is_near)
        rows, near_m = plane_rows(target, points[near], T_first_second, indices[near])
        distances_m = np.full(len(points), np.inf)
        distances_m[near] = near_m
        if len(near) < _FEWEST_PAIRS:
            break
        weights = 1.0 / (1.0 + (near_m / (_SCALE_VOXELS * target.voxel_m)) ** 2)
        information = np.einsum("ni,n,nj->ij", rows, weights, rows) + 1e-6 * np.eye(6)
        moved = np.linalg.solve(information, -rows.T @ (weights * near_m))
        T_first_second = T_first_second @ exp(moved[:3], moved[3:])
        turned_rad, moved_m = float(np.linalg.norm(moved[:3])), float(np.linalg.norm(moved[3:]))
        if turned_rad <= _SETTLED_RAD and moved_m <= _SETTLED_VOXELS * target.voxel_m:
            break
    farthest_m = _FARTHEST_VOXELS * target.voxel_m
    scaled = np.minimum(np.abs(distances_m), farthest_m) / (_SCALE_VOXELS * target.voxel_m)
    return float(np.log1p(scaled**2).mean())


def _scaled(twist: Twist, factor: float) -> Twist:
    return Twist(factor * twist.rotation_radps, factor * twist.translation_mps)


def _middle(sweep: Sweep, factor: float) -> Transform:
    """Return T_world_body (4, 4) in the middle of a sweep."""
    return sweep.T_world_body @ _scaled(sweep.twist, factor).over(sweep.observation.middle_s)
