"""Camera poses from 3D–2D pairs: P3P without a first guess, least reprojection error, and how sure it is."""

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform
from mapper.core.linear import solve_positive, twist_exp
from mapper.features.matching import drawing_order

CHI2_2DOF, CHI2_3DOF = 5.991, 7.815
"""95 % quantiles of χ²: of an image point without and with depth."""

HUBER_2DOF, HUBER_3DOF = np.sqrt(CHI2_2DOF), np.sqrt(CHI2_3DOF)
"""Residual lengths at which Huber's kernel becomes linear."""

NEAREST_M = 0.05
"""Distance before the camera from which on a point can be seen."""

VIRTUAL_BASELINE_PX_M = 40.0
"""bf where no setting has it: depth z counts as the disparity bf / z (Mur-Artal & Tardós 2017)."""
_CONFIDENCE = 0.999
_COLUMNS, _ROWS = 4, 3
"""Cells of the image; features of one cell share the errors of lens, depth and shutter."""


def image_measurements(
    pixels: Array, depth_m: Array, intrinsics: Array, *, sigma_px: Array, disparity_sigma_px: Array
) -> tuple[Array, Array, Array]:
    """Return what ``refine_pose`` takes of features: (N, 3) measured, (N, 3) weights, (5,) intrinsics.

    Args:
        pixels: (N, 2) undistorted pixels.
        depth_m: (N,) NaN without depth.
        intrinsics: (4,) fx, fy, cx, cy.
        sigma_px: (N,) standard deviation of a feature's pixel, along both axes.
        disparity_sigma_px: (N,) likewise of bf / z; finite without depth, too.
    """
    return (
        np.column_stack([pixels, VIRTUAL_BASELINE_PX_M / depth_m]),
        np.column_stack([sigma_px, sigma_px, disparity_sigma_px]) ** -2.0,
        np.append(intrinsics, VIRTUAL_BASELINE_PX_M),
    )


def disparity_sigmas_px(depth_m: Array, sigma_m: Array) -> Array:
    """Return the (N,) standard deviations of bf / z by those of (N,) depths, both in metres.

    Without depth it is 1: the weight is not used, but it is a factor in sums.
    """
    return np.where(np.isnan(depth_m), 1.0, VIRTUAL_BASELINE_PX_M / depth_m**2 * sigma_m)


@njit(cache=True, nogil=True)
def residual(T, point, measured, intrinsics, out):
    """Write the residual (3,) of a world point in a camera, and return the point (x, y, z) in its frame.

    Args:
        T: (4, 4) T_camera_world.
        point: (3,) metres, world.
        measured: (3,) u, v in pixels and virtual disparity bf / z in pixels, NaN without depth.
        intrinsics: (5,) fx, fy, cx, cy and bf.
        out: (3,) measured − predicted, 0 in the third element without depth.
    """
    x = T[0, 0] * point[0] + T[0, 1] * point[1] + T[0, 2] * point[2] + T[0, 3]
    y = T[1, 0] * point[0] + T[1, 1] * point[1] + T[1, 2] * point[2] + T[1, 3]
    z = T[2, 0] * point[0] + T[2, 1] * point[1] + T[2, 2] * point[2] + T[2, 3]
    inverse_z = 1.0 / max(z, 1e-3)
    out[0] = measured[0] - (intrinsics[0] * x * inverse_z + intrinsics[2])
    out[1] = measured[1] - (intrinsics[1] * y * inverse_z + intrinsics[3])
    out[2] = 0.0 if np.isnan(measured[2]) else measured[2] - intrinsics[4] * inverse_z
    return x, y, z


@njit(cache=True, nogil=True)
def chi2(r, weights):
    """Return the squared Mahalanobis length of a residual (3,) with inverse variances (3,)."""
    return weights[0] * r[0] * r[0] + weights[1] * r[1] * r[1] + weights[2] * r[2] * r[2]


@njit(cache=True, nogil=True)
def projection_jacobian(x, y, z, intrinsics, has_depth, J):
    """Write d(u, v, bf/z) / d(x, y, z) (3, 3) at a camera-frame point."""
    inverse_z = 1.0 / max(z, 1e-3)
    inverse_z2 = inverse_z * inverse_z
    J[:, :] = 0.0
    J[0, 0] = intrinsics[0] * inverse_z
    J[0, 2] = -intrinsics[0] * x * inverse_z2
    J[1, 1] = intrinsics[1] * inverse_z
    J[1, 2] = -intrinsics[1] * y * inverse_z2
    if has_depth:
        J[2, 2] = -intrinsics[4] * inverse_z2


@njit(cache=True, nogil=True)
def pose_jacobian(x, y, z, J, J_pose):
    """Write d(u, v, bf/z) / dδ (3, 6) for T ← exp(δ) · T, from d(u, v, bf/z) / d(x, y, z)."""
    for i in range(3):
        a, b, c = J[i, 0], J[i, 1], J[i, 2]
        J_pose[i, 0] = -b * z + c * y
        J_pose[i, 1] = a * z - c * x
        J_pose[i, 2] = -a * y + b * x
        J_pose[i, 3] = a
        J_pose[i, 4] = b
        J_pose[i, 5] = c


@njit(inline="always", cache=True, nogil=True)
def huber(e, has_depth):
    """Return the weight of a residual of squared length ``e``, and its cost (Huber 1964)."""
    k = HUBER_3DOF if has_depth else HUBER_2DOF
    if e <= k * k:
        return 1.0, e
    root = np.sqrt(e)
    return k / root, 2.0 * k * root - k * k


@njit(inline="always", cache=True, nogil=True)
def linearise(T, point, measured, intrinsics, r, J, J_pose):
    """Write ``residual``, ``projection_jacobian`` and ``pose_jacobian``; return whether there is depth."""
    x, y, z = residual(T, point, measured, intrinsics, r)
    has_depth = not np.isnan(measured[2])
    projection_jacobian(x, y, z, intrinsics, has_depth, J)
    pose_jacobian(x, y, z, J, J_pose)
    return has_depth


@njit(cache=True, nogil=True)
def _normal_equations(T, points, measured, weights, intrinsics, inlier, robust, H, g):
    """Write the normal equations and return the robust cost."""
    H[:, :] = 0.0
    g[:] = 0.0
    r, J, J_pose = np.empty(3), np.empty((3, 3)), np.empty((3, 6))
    total = 0.0
    for n in range(len(points)):
        if not inlier[n]:
            continue
        has_depth = linearise(T, points[n], measured[n], intrinsics, r, J, J_pose)
        scale, cost = 1.0, chi2(r, weights[n])
        if robust:
            scale, cost = huber(cost, has_depth)
        total += cost
        for i in range(3):
            w = scale * weights[n, i]
            for a in range(6):
                wa = w * J_pose[i, a]
                g[a] += wa * r[i]
                for b in range(a, 6):
                    H[a, b] += wa * J_pose[i, b]
    for a in range(6):
        for b in range(a):
            H[a, b] = H[b, a]
    return total


@njit(cache=True, nogil=True)
def normal_matrix(T_camera_world, points, measured, weights, intrinsics):
    """Return the (6, 6) robust normal matrix of exp(δ) · T_camera_world; arguments as for ``refine_pose``."""
    H, g = np.zeros((6, 6)), np.zeros(6)
    inlier = np.ones(len(points), np.bool_)
    _normal_equations(T_camera_world, points, measured, weights, intrinsics, inlier, True, H, g)
    return H


@njit(cache=True, nogil=True)
def scores(T_camera_world, points, measured, weights, intrinsics):
    """Return each point's (N, 6) gradient of −½ χ² at exp(δ) · T_camera_world, and its (N,) χ².

    Arguments as for ``refine_pose``.
    """
    gradients, squares = np.zeros((len(points), 6)), np.empty(len(points))
    r, J, J_pose = np.empty(3), np.empty((3, 3)), np.empty((3, 6))
    for n in range(len(points)):
        linearise(T_camera_world, points[n], measured[n], intrinsics, r, J, J_pose)
        squares[n] = chi2(r, weights[n])
        for i in range(3):
            for a in range(6):
                gradients[n, a] += weights[n, i] * r[i] * J_pose[i, a]
    return gradients, squares


@njit(inline="always", cache=True, nogil=True)
def is_inlier(T, point, measured, weights, intrinsics, r):
    """Return whether a point is before the camera and its χ² passes the 95 % test; write its residual."""
    _, _, z = residual(T, point, measured, intrinsics, r)
    limit = CHI2_2DOF if np.isnan(measured[2]) else CHI2_3DOF
    return z > NEAREST_M and chi2(r, weights) <= limit


@njit(cache=True, nogil=True)
def classify(T, points, measured, weights, intrinsics, inlier):
    """Mark the inliers; return how many."""
    r = np.empty(3)
    count = 0
    for n in range(len(points)):
        inlier[n] = is_inlier(T, points[n], measured[n], weights[n], intrinsics, r)
        count += inlier[n]
    return count


@njit(cache=True, nogil=True)
def refine_pose(T_camera_world, points, measured, weights, intrinsics, rounds, iterations):
    """Return the refined T_camera_world, the inlier mask and the (6, 6) normal matrix.

    Levenberg–Marquardt on (u, v, bf/z) with Huber's kernel; after each round points are classified anew by
    χ², and the last round has no kernel (Mur-Artal & Tardós 2017, §III-C).

    Args:
        T_camera_world: (4, 4) first guess.
        points: (N, 3) metres, world.
        measured: (N, 3) u, v, bf/z in pixels; NaN in the third column without depth.
        weights: (N, 3) inverse variances of the three, px⁻².
        intrinsics: (5,) fx, fy, cx, cy, bf.
        rounds: Number of times inliers are classified.
        iterations: Largest number of steps per round.
    """
    T = T_camera_world.copy()
    inlier = np.ones(len(points), np.bool_)
    H, trial_H = np.zeros((6, 6)), np.zeros((6, 6))
    g, trial_g = np.zeros(6), np.zeros(6)
    for k in range(rounds):
        robust = k < rounds - 1
        damping = 1e-4
        cost = _normal_equations(T, points, measured, weights, intrinsics, inlier, robust, H, g)
        for _ in range(iterations):
            A = H.copy()
            for a in range(6):
                A[a, a] += damping * H[a, a] + 1e-9
            delta = solve_positive(A, g)
            trial = twist_exp(delta, T)
            trial_cost = _normal_equations(
                trial, points, measured, weights, intrinsics, inlier, robust, trial_H, trial_g
            )
            if trial_cost <= cost:
                converged = cost - trial_cost < 1e-5 * cost
                T, cost, damping = trial, trial_cost, max(damping * 0.2, 1e-9)
                H, trial_H = trial_H, H
                g, trial_g = trial_g, g
                if converged:
                    break
            else:
                damping *= 10.0
                if damping > 1e3:
                    break
        if classify(T, points, measured, weights, intrinsics, inlier) < 6:
            break
    return T, inlier, H


def ransac_p3p(
    points_world: Points,
    pixels: Array,
    intrinsics: Array,
    *,
    tolerance_px: float,
    iterations: int,
    seed: int = 0,
) -> tuple[Transform, NDArray[np.intp]] | None:
    """Return the T_camera_world with most inlier pairs, and their indices; None if no four pairs give a pose.

    Three pairs have up to four solutions (Gao et al. 2003); a fourth pair chooses among them.

    Args:
        points_world: (N, 3) metres, N ≥ 4.
        pixels: (N, 2) their undistorted pixels.
        intrinsics: (≥ 4,) fx, fy, cx, cy.
        tolerance_px: A pair is an inlier when its point projects this close to its pixel (β in the paper).
        iterations: Largest number of draws; fewer once a better one has become unlikely.
        seed: Seed of the draws; see ``drawing_order``.
    """
    fx, fy, cx, cy = intrinsics[:4]
    order = drawing_order(len(pixels), seed)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points_world[order],
        pixels[order],
        np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        None,
        iterationsCount=iterations,
        reprojectionError=tolerance_px,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not found or inliers is None:
        return None
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3], _ = cv2.Rodrigues(rotation)
    T_camera_world[:3, 3] = translation[:, 0]
    return T_camera_world, np.sort(order[inliers[:, 0]])


def variance_factor(
    T_camera_world: Transform, points: Points, measured: Array, weights: Array, intrinsics: Array
) -> float:
    """Return by how much the inverse of a pose's normal matrix has to be multiplied to be its covariance.

    It is the mean square of the residuals in standard deviations, times their design effect: by how much
    residuals that agree within a cell of the image carry less information than independent ones (Kish 1965,
    §5.4), at least 1. That is the cluster-robust covariance of the scores (Liang & Zeger 1986, eq. 8)
    relative to that of independent ones: one number for all directions, as a few cells do not determine a
    matrix.

    Args:
        T_camera_world: (4, 4) at the least squares.
        points: (N, 3) metres, world; inliers only.
        measured: (N, 3) u, v, bf/z in pixels; NaN in the third column without depth.
        weights: (N, 3) inverse variances of the three, px⁻².
        intrinsics: (5,) fx, fy, cx, cy, bf.
    """
    gradients, squares = scores(T_camera_world, points, measured, weights, intrinsics)
    freedom = int(np.isfinite(measured).sum()) - 6
    if freedom <= 0:
        return 1.0
    variance = float(squares.sum()) / freedom
    share = measured[:, :2] / (2.0 * intrinsics[2:4])
    cell = np.clip((share * [_COLUMNS, _ROWS]).astype(np.intp), 0, [_COLUMNS - 1, _ROWS - 1])
    cells, cell_of = np.unique(cell @ [1, _COLUMNS], return_inverse=True)
    if len(cells) < 2:
        return variance
    sums = np.zeros((len(cells), 6))
    np.add.at(sums, cell_of, gradients)
    covariance = np.linalg.inv(normal_matrix(T_camera_world, points, measured, weights, intrinsics))
    together, alone = (float(np.einsum("na,ab,nb->", g, covariance, g)) for g in (sums, gradients))
    return variance * max(1.0, together * len(cells) / (len(cells) - 1) / alone)
