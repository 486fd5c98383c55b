"""Poses by samples of pairs, and how much of a scene a pose explains: RANSAC among several motions."""

import numpy as np
from numba import njit

from mapper.core.geometry import Array, Points, Transform
from mapper.registration.reprojection import CHI2_2DOF, CHI2_3DOF, chi2, classify, refine_pose, residual

_DRAWS, _PAIRS = 60, 4
"""Samples, and pairs in each: of a motion of half of the scene there are four samples on average."""
_KEPT = 4
"""Best samples that are refined by all pairs that agree with them."""
_REFINEMENTS, _ITERATIONS = 2, 8
_NEAR_M = 0.3
"""Points that are closer count together as one: half the width of a person. 0.2 and 0.5 serve as well."""

_TABLE = np.random.default_rng(0).random((_DRAWS, _PAIRS))


def shares_of_scene(points: Points) -> Array:
    """Return (N,) one over the number of points near each: sums of them tell how much of a scene is shown.

    Things that move are small beside the scene they move in, but may have most of its texture.
    """
    shares: Array = _one_over_near(points)
    return shares


@njit(cache=True, nogil=True)
def _one_over_near(points):  # type: ignore[no-untyped-def]
    near = np.ones(len(points))
    for i in range(len(points)):
        for j in range(i):
            dx, dy = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]
            dz = points[i, 2] - points[j, 2]
            if dx * dx + dy * dy + dz * dz < _NEAR_M**2:
                near[i] += 1.0
                near[j] += 1.0
    return 1.0 / near


@njit(cache=True, nogil=True)
def support(T_camera_world, points, measured, weights, intrinsics, shares):  # type: ignore[no-untyped-def]
    """Return how much of a scene a pose explains: its MSAC gain (Torr & Zisserman 2000).

    A pair counts by how well it fits, from its share down to 0 at the limit of χ²: a compromise between two
    motions has many pairs within the limit, but few that fit well.
    """
    r = np.empty(3)
    gain = 0.0
    for n in range(len(points)):
        _, _, z = residual(T_camera_world, points[n], measured[n], intrinsics, r)
        limit = CHI2_2DOF if np.isnan(measured[n, 2]) else CHI2_3DOF
        if z > 0.05:
            gain += shares[n] * max(1.0 - chi2(r, weights[n]) / limit, 0.0)
    return gain


def sampled_pose(
    T_camera_world: Transform,
    points: Points,
    measured: Array,
    weights: Array,
    intrinsics: Array,
    shares: Array,
) -> Transform:
    """Return the pose with most support among those of samples of the pairs.

    Locally optimised RANSAC (Chum, Matas & Kittler 2003) that draws pairs by their shares of the scene. The
    draws are the same every time. Arguments as for ``support``.
    """
    ends = np.cumsum(shares)
    samples = np.minimum(np.searchsorted(ends, _TABLE * ends[-1]), len(points) - 1)
    T_best: Transform = _best_of_samples(
        T_camera_world, points, measured, weights, intrinsics, shares, samples
    )
    return T_best


@njit(cache=True, nogil=True)
def _best_of_samples(T, points, measured, weights, intrinsics, shares, samples):  # type: ignore[no-untyped-def]
    poses = np.empty((len(samples), 4, 4))
    supports = np.empty(len(samples))
    for k in range(len(samples)):
        s = samples[k]
        poses[k], _, _ = refine_pose(T, points[s], measured[s], weights[s], intrinsics, 1, _ITERATIONS)
        supports[k] = support(poses[k], points, measured, weights, intrinsics, shares)
    T_best, most = T.copy(), -1.0
    agree = np.empty(len(points), np.bool_)
    for k in np.argsort(-supports)[:_KEPT]:
        refined = poses[k].copy()
        for _ in range(_REFINEMENTS):
            if classify(refined, points, measured, weights, intrinsics, agree) < 2 * _PAIRS:
                break
            refined, _, _ = refine_pose(
                refined, points[agree], measured[agree], weights[agree], intrinsics, 2, _ITERATIONS
            )
        gain = support(refined, points, measured, weights, intrinsics, shares)
        if gain > most:
            T_best, most = refined, gain
    return T_best
