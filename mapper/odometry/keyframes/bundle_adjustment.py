"""Local bundle adjustment: compiled Levenberg–Marquardt with points eliminated (Triggs et al. 2000, §6.1)."""

import numpy as np
from numba import njit

from mapper.core.linear import between, product, solve_positive, turned, twist_exp
from mapper.registration.reprojection import (
    chi2,
    huber,
    is_inlier,
    pose_jacobian,
    projection_jacobian,
    residual,
)


@njit(cache=True, nogil=True)
def _link_error(T_measured, T_to, T_from, e):
    """Write the (6,) twist by which a relative pose misses its measurement; small-angle in the rotation."""
    T = between(T_to, T_from)
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
def _cost(poses, points, edges, measured, weights, intrinsics, active, robust):
    r = np.empty(3)
    total = 0.0
    for e in range(len(edges)):
        if not active[e]:
            continue
        residual(poses[edges[e, 0]], points[edges[e, 1]], measured[e], intrinsics, r)
        cost = chi2(r, weights[e])
        if robust:
            _, cost = huber(cost, not np.isnan(measured[e, 2]))
        total += cost
    return total


@njit(cache=True, nogil=True)
def _linearise(poses, free, points, edges, measured, weights, intrinsics, active, robust, blocks):
    """Write the blocks of the normal equations: cameras (6, 6), points (3, 3), and one (6, 3) per edge."""
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
        scale = 1.0
        if robust:
            scale, _ = huber(chi2(r, weights[e]), has_depth)
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
def _inverse3(M, out):
    """Write the inverse of a symmetric positive definite (3, 3) matrix by its adjugate."""
    a = M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1]
    b = M[0, 2] * M[2, 1] - M[0, 1] * M[2, 2]
    c = M[0, 1] * M[1, 2] - M[0, 2] * M[1, 1]
    inverse_determinant = 1.0 / (M[0, 0] * a + M[1, 0] * b + M[2, 0] * c)
    out[0, 0] = a * inverse_determinant
    out[0, 1] = out[1, 0] = b * inverse_determinant
    out[0, 2] = out[2, 0] = c * inverse_determinant
    out[1, 1] = (M[0, 0] * M[2, 2] - M[0, 2] * M[2, 0]) * inverse_determinant
    out[1, 2] = out[2, 1] = (M[0, 2] * M[1, 0] - M[0, 0] * M[1, 2]) * inverse_determinant
    out[2, 2] = (M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]) * inverse_determinant


@njit(cache=True, nogil=True)
def _step(free, first_edge, edges, active, blocks, damping, pairs=None, across=None):
    """Return the damped step of cameras (C, 6) and points (P, 3) through the Schur complement.

    ``across`` (Q, 6, 6) are the blocks between linked cameras, ``pairs`` (Q, 2) their keyframes.
    """
    Hcc, bc, Hpp, bp, W = blocks
    cameras, points = len(Hcc), len(Hpp)
    S = np.zeros((6 * cameras, 6 * cameras))
    rhs = np.empty(6 * cameras)
    for f in range(cameras):
        for a in range(6):
            rhs[6 * f + a] = bc[f, a]
            for b in range(6):
                S[6 * f + a, 6 * f + b] = Hcc[f, a, b]
            S[6 * f + a, 6 * f + a] += damping * Hcc[f, a, a] + 1e-6
    if across is not None:
        for q in range(len(across)):
            f, g = free[pairs[q, 0]], free[pairs[q, 1]]
            if f >= 0 and g >= 0:
                for a in range(6):
                    for b in range(6):  # the upper triangle is copied to the lower
                        if f < g:
                            S[6 * f + b, 6 * g + a] += across[q, a, b]
                        else:
                            S[6 * g + a, 6 * f + b] += across[q, a, b]
    inverses = np.empty((points, 3, 3))
    damped = np.empty((3, 3))
    WV = np.empty((6, 3))
    for p in range(points):
        damped[:] = Hpp[p]
        for a in range(3):
            damped[a, a] += damping * Hpp[p, a, a] + 1e-6
        _inverse3(damped, inverses[p])
        V = inverses[p]
        for e in range(first_edge[p], first_edge[p + 1]):
            f = free[edges[e, 0]]
            if f < 0 or not active[e]:
                continue
            for a in range(6):
                for b in range(3):
                    WV[a, b] = W[e, a, 0] * V[0, b] + W[e, a, 1] * V[1, b] + W[e, a, 2] * V[2, b]
                rhs[6 * f + a] -= WV[a, 0] * bp[p, 0] + WV[a, 1] * bp[p, 1] + WV[a, 2] * bp[p, 2]
            for other in range(first_edge[p], first_edge[p + 1]):
                g = free[edges[other, 0]]
                if g < f or not active[other]:
                    continue
                for a in range(6):
                    for b in range(6):
                        S[6 * f + a, 6 * g + b] -= (
                            WV[a, 0] * W[other, b, 0] + WV[a, 1] * W[other, b, 1] + WV[a, 2] * W[other, b, 2]
                        )
    for i in range(6 * cameras):
        for j in range(i):
            S[i, j] = S[j, i]
    step_cameras = solve_positive(S, rhs).reshape(cameras, 6)
    step_points = np.empty((points, 3))
    residue = np.empty(3)
    for p in range(points):
        residue[:] = bp[p]
        for e in range(first_edge[p], first_edge[p + 1]):
            f = free[edges[e, 0]]
            if f < 0 or not active[e]:
                continue
            for a in range(6):
                for b in range(3):
                    residue[b] -= W[e, a, b] * step_cameras[f, a]
        step_points[p] = turned(inverses[p], residue)
    return step_cameras, step_points


@njit(cache=True, nogil=True)
def adjust(poses, free, points, first_edge, edges, measured, weights, intrinsics, links, rounds, iterations):
    """Return refined poses and points, and which edges pass the last χ² test.

    Args:
        poses: (K, 4, 4) T_camera_world of free and fixed keyframes.
        free: (K,) int32: rank among the free keyframes, −1 for a fixed one.
        points: (P, 3) metres, world.
        first_edge: (P + 1,) int32: first edge of each point; edges are grouped by point.
        edges: (E, 2) int32 keyframe and point of each observation.
        measured: (E, 3) u, v, bf/z in pixels; NaN in the third column without depth.
        weights: (E, 3) inverse variances, px⁻².
        intrinsics: (5,) fx, fy, cx, cy, bf.
        links: Measured relative poses, as by depth: (Q, 2) int32 keyframes i and j, (Q, 4, 4) T_j_i, and the
            (6, 6) information of each in j's tangent.
        rounds: How often outliers are classified; only the first round is robust.
        iterations: Largest number of steps per round.
    """
    poses, points = poses.copy(), points.copy()
    cameras = int(free.max()) + 1
    Hcc, bc = np.empty((cameras, 6, 6)), np.empty((cameras, 6))
    Hpp, bp = np.empty((len(points), 3, 3)), np.empty((len(points), 3))
    W = np.zeros((len(edges), 6, 3))
    blocks = Hcc, bc, Hpp, bp, W
    across = np.zeros((len(links[0]), 6, 6))
    active = np.ones(len(edges), np.bool_)
    r = np.empty(3)
    for k in range(rounds):
        robust = k == 0
        damping = 1e-4
        cost = _cost(poses, points, edges, measured, weights, intrinsics, active, robust)
        cost += _link_cost(poses, links)
        _linearise(poses, free, points, edges, measured, weights, intrinsics, active, robust, blocks)
        _add_links(poses, free, links, Hcc, bc, across)
        for _ in range(iterations):
            step_cameras, step_points = _step(
                free, first_edge, edges, active, blocks, damping, links[0], across
            )
            trial_poses = poses.copy()
            for c in range(len(poses)):
                if free[c] >= 0:
                    trial_poses[c] = twist_exp(step_cameras[free[c]], poses[c])
            trial_points = points + step_points
            trial = _cost(trial_poses, trial_points, edges, measured, weights, intrinsics, active, robust)
            trial += _link_cost(trial_poses, links)
            if trial <= cost:
                converged = cost - trial < 1e-4 * cost
                poses, points, cost, damping = trial_poses, trial_points, trial, damping * 0.2
                if converged:
                    break
                _linearise(poses, free, points, edges, measured, weights, intrinsics, active, robust, blocks)
                _add_links(poses, free, links, Hcc, bc, across)
            else:
                damping *= 10.0
                if damping > 1e3:
                    break
        for e in range(len(edges)):
            T, point = poses[edges[e, 0]], points[edges[e, 1]]
            active[e] = is_inlier(T, point, measured[e], weights[e], intrinsics, r)
    return poses, points, active


@njit(cache=True, nogil=True)
def common_parameter(poses, free, points, first_edge, edges, measured, weights, intrinsics, active, slopes):
    """Return the information on a parameter common to all edges, and the gradient of half their χ².

    Poses and points are eliminated, so the parameter's Gauss–Newton step is −gradient / information.

    Args:
        poses: As for ``adjust``, at its solution, likewise all but the last two.
        free: As for ``adjust``.
        points: As for ``adjust``.
        first_edge: As for ``adjust``.
        edges: As for ``adjust``.
        measured: As for ``adjust``.
        weights: As for ``adjust``.
        intrinsics: As for ``adjust``.
        active: (E,) edges that take part.
        slopes: (E, 2) change of the residuals of u and v with the parameter.
    """
    cameras = int(free.max()) + 1
    Hcc, bc = np.empty((cameras, 6, 6)), np.empty((cameras, 6))
    Hpp, bp = np.empty((len(points), 3, 3)), np.empty((len(points), 3))
    W = np.zeros((len(edges), 6, 3))
    blocks = Hcc, bc, Hpp, bp, W
    _linearise(poses, free, points, edges, measured, weights, intrinsics, active, False, blocks)
    coupling_c, coupling_p = np.zeros((cameras, 6)), np.zeros((len(points), 3))
    r = np.empty(3)
    J = np.empty((3, 3))
    J_pose = np.empty((3, 6))
    information = gradient = 0.0
    for e in range(len(edges)):
        if not active[e]:
            continue
        c, p = edges[e, 0], edges[e, 1]
        T = poses[c]
        x, y, z = residual(T, points[p], measured[e], intrinsics, r)
        projection_jacobian(x, y, z, intrinsics, False, J)
        pose_jacobian(x, y, z, J, J_pose)
        f = free[c]
        for i in range(2):
            ws = weights[e, i] * slopes[e, i]
            information += ws * slopes[e, i]
            gradient += ws * r[i]
            for a in range(3):
                coupling_p[p, a] += ws * (J[i, 0] * T[0, a] + J[i, 1] * T[1, a] + J[i, 2] * T[2, a])
            if f >= 0:
                for a in range(6):
                    coupling_c[f, a] += ws * J_pose[i, a]
    for f in range(cameras):  # the residuals' own gradient gives way to that of the coupling
        bc[f] = coupling_c[f]
    bp[:] = coupling_p
    moved_c, moved_p = _step(free, first_edge, edges, active, blocks, 0.0)
    information -= (coupling_c * moved_c).sum() + (coupling_p * moved_p).sum()
    return information, gradient
