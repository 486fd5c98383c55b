"""Local bundle adjustment: compiled Levenberg–Marquardt with points eliminated (Triggs et al. 2000, §6.1)."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points
from mapper.core.linear import product, turned, twist_exp
from mapper.odometry.local_map.bundle.schur_complement import damped_step, empty_blocks
from mapper.registration.reprojection import (
    CHI2_2DOF,
    CHI2_3DOF,
    HUBER_2DOF,
    HUBER_3DOF,
    chi2,
    pose_jacobian,
    projection_jacobian,
    residual,
)


class Observations(NamedTuple):
    """Observations of points in keyframes, grouped by point.

    Attributes:
        first_edge: (P + 1,) int32 first observation of each point.
        edges: (E, 2) int32 keyframe and point of each.
        measured: (E, 3) u, v, bf/z in pixels; NaN in the third column without depth.
        weights: (E, 3) inverse variances, px⁻².
        intrinsics: (5,) fx, fy, cx, cy, bf.
    """

    first_edge: NDArray[np.int32]
    edges: NDArray[np.int32]
    measured: Array
    weights: Array
    intrinsics: Array


@njit(cache=True, nogil=True)
def _link_error(T_measured, T_to, T_from, e):
    """Write the (6,) twist by which a relative pose misses its measurement; small-angle in the rotation."""
    T = np.eye(4)
    T[:3, :3] = product(T_to, T_from[:3, :3].T.copy())
    T[:3, 3] = T_to[:3, 3] - turned(T, T_from[:3, 3])
    R = product(T_measured, T[:3, :3].T.copy())
    for a in range(3):
        e[3 + a] = T_measured[a, 3] - R[a, 0] * T[0, 3] - R[a, 1] * T[1, 3] - R[a, 2] * T[2, 3]
    e[0], e[1], e[2] = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    return T


@njit(cache=True, nogil=True)
def _add_links(poses, free, links, Hcc, bc, across):
    """Add measured relative poses to the cameras' blocks; write the blocks between two free cameras."""
    pairs, T_measured, information = links
    e, A = np.empty(6), np.zeros((6, 6))
    for q in range(len(pairs)):
        f, g = free[pairs[q, 0]], free[pairs[q, 1]]
        T = _link_error(T_measured[q], poses[pairs[q, 1]], poses[pairs[q, 0]], e)
        A[:3, :3] = T[:3, :3]
        A[3:, 3:] = T[:3, :3]
        x, y, z = T[0, 3], T[1, 3], T[2, 3]
        for k in range(3):  # [t]× · R: the adjoint of T
            A[3, k], A[4, k] = y * T[2, k] - z * T[1, k], z * T[0, k] - x * T[2, k]
            A[5, k] = x * T[1, k] - y * T[0, k]
        H = information[q]
        for a in range(6):
            for b in range(6):
                if g >= 0:
                    bc[g, a] += H[a, b] * e[b]
                    Hcc[g, a, b] += H[a, b]
                across[q, a, b] = 0.0
                for k in range(6):
                    across[q, a, b] -= H[a, k] * A[k, b]
        if f >= 0:
            for a in range(6):
                for b in range(6):
                    bc[f, a] += across[q, b, a] * e[b]
                    for k in range(6):
                        Hcc[f, a, b] -= A[k, a] * across[q, k, b]


@njit(cache=True, nogil=True)
def _link_cost(poses, links):
    pairs, T_measured, information = links
    e, total = np.empty(6), 0.0
    for q in range(len(pairs)):
        _link_error(T_measured[q], poses[pairs[q, 1]], poses[pairs[q, 0]], e)
        for a in range(6):
            for b in range(6):
                total += e[a] * information[q, a, b] * e[b]
    return total


@njit(cache=True, nogil=True)
def _cost(poses, points, observations, active, robust):
    _, edges, measured, weights, intrinsics = observations
    r = np.empty(3)
    total = 0.0
    for e in range(len(edges)):
        if not active[e]:
            continue
        residual(poses[edges[e, 0]], points[edges[e, 1]], measured[e], intrinsics, r)
        value = chi2(r, weights[e])
        k = HUBER_2DOF if np.isnan(measured[e, 2]) else HUBER_3DOF
        if robust and value > k * k:
            total += 2.0 * k * np.sqrt(value) - k * k
        else:
            total += value
    return total


@njit(cache=True, nogil=True)
def _linearise(poses, free, points, observations, active, robust, blocks):
    """Write the blocks of the normal equations."""
    _, edges, measured, weights, intrinsics = observations
    Hcc, bc, Hpp, bp, W = blocks
    Hcc[:] = 0.0
    bc[:] = 0.0
    Hpp[:] = 0.0
    bp[:] = 0.0
    r = np.empty(3)
    J = np.empty((3, 3))
    J_pose = np.empty((3, 6))
    J_point = np.empty((3, 3))
    for e in range(len(edges)):
        if not active[e]:
            continue
        c, p = edges[e, 0], edges[e, 1]
        T = poses[c]
        x, y, z = residual(T, points[p], measured[e], intrinsics, r)
        has_depth = not np.isnan(measured[e, 2])
        value = chi2(r, weights[e])
        k = HUBER_3DOF if has_depth else HUBER_2DOF
        scale = k / np.sqrt(value) if robust and value > k * k else 1.0
        projection_jacobian(x, y, z, intrinsics, has_depth, J)
        for i in range(3):
            for j in range(3):
                J_point[i, j] = J[i, 0] * T[0, j] + J[i, 1] * T[1, j] + J[i, 2] * T[2, j]
        for i in range(3):
            w = scale * weights[e, i]
            for a in range(3):
                wa = w * J_point[i, a]
                bp[p, a] += wa * r[i]
                for b in range(3):
                    Hpp[p, a, b] += wa * J_point[i, b]
        f = free[c]
        if f < 0:
            continue
        pose_jacobian(x, y, z, J, J_pose)
        for a in range(6):
            for b in range(3):
                W[e, a, b] = 0.0
        for i in range(3):
            w = scale * weights[e, i]
            for a in range(6):
                wa = w * J_pose[i, a]
                bc[f, a] += wa * r[i]
                for b in range(6):
                    Hcc[f, a, b] += wa * J_pose[i, b]
                for b in range(3):
                    W[e, a, b] += wa * J_point[i, b]


@njit(cache=True, nogil=True)
def _moved(poses, free, step_cameras):
    """Return (K, 4, 4) poses of which the free ones took their step."""
    moved = poses.copy()
    for c in range(len(poses)):
        if free[c] >= 0:
            moved[c] = twist_exp(step_cameras[free[c]], poses[c])
    return moved


@njit(cache=True, nogil=True)
def _classify(poses, points, observations, active):
    """Write which edges pass the χ² test."""
    _, edges, measured, weights, intrinsics = observations
    r = np.empty(3)
    for e in range(len(edges)):
        _, _, z = residual(poses[edges[e, 0]], points[edges[e, 1]], measured[e], intrinsics, r)
        limit = CHI2_2DOF if np.isnan(measured[e, 2]) else CHI2_3DOF
        active[e] = z > 0.05 and chi2(r, weights[e]) <= limit


@njit(cache=True, nogil=True)
def adjust(poses, free, points, observations, links, rounds, iterations):
    """Return refined poses and points, and which edges pass the last χ² test.

    Args:
        poses: (K, 4, 4) T_camera_world of free and fixed keyframes.
        free: (K,) int32: rank among the free keyframes, −1 for a fixed one.
        points: (P, 3) metres, world.
        observations: ``Observations`` of the points, the edges of the graph.
        links: Measured relative poses, as by depth: (Q, 2) int32 keyframes i and j, (Q, 4, 4) T_j_i, and the
            (6, 6) information of each in j's tangent.
        rounds: How often outliers are classified; only the first round is robust.
        iterations: Largest number of steps per round.
    """
    poses, points = poses.copy(), points.copy()
    first_edge, edges = observations.first_edge, observations.edges
    blocks = empty_blocks(int(free.max()) + 1, len(points), len(edges))
    across = np.zeros((len(links[0]), 6, 6))
    active = np.ones(len(edges), np.bool_)
    for k in range(rounds):
        robust = k == 0
        damping = 1e-4
        cost = _cost(poses, points, observations, active, robust)
        cost += _link_cost(poses, links)
        _linearise(poses, free, points, observations, active, robust, blocks)
        _add_links(poses, free, links, blocks.Hcc, blocks.bc, across)
        for _ in range(iterations):
            step_cameras, step_points = damped_step(
                free, first_edge, edges, active, blocks, damping, links[0], across
            )
            trial_poses, trial_points = _moved(poses, free, step_cameras), points + step_points
            trial = _cost(trial_poses, trial_points, observations, active, robust)
            trial += _link_cost(trial_poses, links)
            if trial <= cost:
                converged = cost - trial < 1e-4 * cost
                poses, points, cost, damping = trial_poses, trial_points, trial, damping * 0.2
                if converged:
                    break
                _linearise(poses, free, points, observations, active, robust, blocks)
                _add_links(poses, free, links, blocks.Hcc, blocks.bc, across)
            else:
                damping *= 10.0
                if damping > 1e3:
                    break
        _classify(poses, points, observations, active)
    return poses, points, active


def common_parameter(
    poses: Array,
    free: NDArray[np.int32],
    points: Points,
    observations: Observations,
    active: NDArray[np.bool_],
    slopes: Array,
) -> tuple[float, float]:
    """Return the information on a parameter common to all edges, and the gradient of half their χ².

    As ``common_parameters`` of one parameter, whose slopes are (E, 2 or 3).
    """
    information, gradient = common_parameters(poses, free, points, observations, active, slopes[np.newaxis])
    return float(information[0, 0]), float(gradient[0])


@njit(cache=True, nogil=True)
def common_parameters(poses, free, points, observations, active, slopes):
    """Return the information on parameters common to all edges, and the gradient of half their χ².

    Poses and points are eliminated, so the parameters' Gauss–Newton step is −information⁻¹ · gradient.

    Args:
        poses: As for ``adjust``, at its solution, likewise all but the last two.
        free: As for ``adjust``.
        points: As for ``adjust``.
        observations: As for ``adjust``.
        active: (E,) edges that take part.
        slopes: (N, E, 2) change of the residuals of u and v with each of N parameters, or (N, E, 3) with that
            of bf/z.
    """
    first_edge, edges, measured, weights, intrinsics = observations
    cameras, count = int(free.max()) + 1, len(slopes)
    blocks = empty_blocks(cameras, len(points), len(edges))
    _linearise(poses, free, points, observations, active, False, blocks)
    coupling_c, coupling_p = np.zeros((count, cameras, 6)), np.zeros((count, len(points), 3))
    r = np.empty(3)
    J = np.empty((3, 3))
    J_pose = np.empty((3, 6))
    information, gradient = np.zeros((count, count)), np.zeros(count)
    for e in range(len(edges)):
        if not active[e]:
            continue
        c, p = edges[e, 0], edges[e, 1]
        T = poses[c]
        x, y, z = residual(T, points[p], measured[e], intrinsics, r)
        projection_jacobian(x, y, z, intrinsics, not np.isnan(measured[e, 2]), J)
        pose_jacobian(x, y, z, J, J_pose)
        f = free[c]
        for n in range(count):
            for i in range(slopes.shape[2]):
                ws = weights[e, i] * slopes[n, e, i]
                for m in range(n + 1):
                    information[n, m] += ws * slopes[m, e, i]
                gradient[n] += ws * r[i]
                for a in range(3):
                    coupling_p[n, p, a] += ws * (J[i, 0] * T[0, a] + J[i, 1] * T[1, a] + J[i, 2] * T[2, a])
                if f >= 0:
                    for a in range(6):
                        coupling_c[n, f, a] += ws * J_pose[i, a]
    for n in range(count):  # in place of the residuals' own gradient, that of the coupling
        blocks.bc[:], blocks.bp[:] = coupling_c[n], coupling_p[n]
        moved_c, moved_p = damped_step(free, first_edge, edges, active, blocks, 0.0)
        for m in range(n + 1):
            information[n, m] -= (coupling_c[m] * moved_c).sum() + (coupling_p[m] * moved_p).sum()
            information[m, n] = information[n, m]
    return information, gradient
