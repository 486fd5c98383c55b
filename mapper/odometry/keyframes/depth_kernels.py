"""Compiled Gauss–Newton of a camera pose on planes of other depth images and on landmarks together."""

import numpy as np
from numba import njit

from mapper.core.linear import between, solve_positive, twist_exp
from mapper.odometry.keyframes.landmark_kernels import MIN_DEPTH_M
from mapper.registration.reprojection import chi2, classify, huber, linearise

_WIDEST = 4.0
"""Squared tangent from the axis beyond which no camera sees, and its distortion is not defined."""
_HUBER = 1.5
_MARGIN_M = 0.01
_MARGIN_SIGMAS = 4.0
_STEP = 1e-5
_INDEPENDENT = 0.25
"""Share of the pairs that count: neighbouring cells have planes and errors in common."""


@njit(cache=True, nogil=True)
def place_in_cells(T, p, optics, cell_px):
    """Return where a point is seen, in rows and columns of cells from their corner, and its depth, metres.

    Row and column are −1 for a point that is not before the camera.
    """
    x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
    y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
    z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
    if z < MIN_DEPTH_M:
        return -1.0, -1.0, z
    u, v = x / z, y / z
    s = u * u + v * v
    if s > _WIDEST:
        return -1.0, -1.0, z
    radial = 1.0 + s * (optics[4] + s * (optics[5] + s * optics[8]))
    du = u * radial + 2.0 * optics[6] * u * v + optics[7] * (s + 2.0 * u * u)
    dv = v * radial + optics[6] * (s + 2.0 * v * v) + 2.0 * optics[7] * u * v
    column = (du * optics[0] + optics[2] + 0.5) / cell_px
    line = (dv * optics[1] + optics[3] + 0.5) / cell_px
    return line, column, z


@njit(cache=True, nogil=True)
def cell_of(T, p, optics, cell_px, shape):
    """Return row and column of the cell that a point is seen in, −1 for none, and its depth, metres."""
    down, across, z = place_in_cells(T, p, optics, cell_px)
    line, column = int(np.floor(down)), int(np.floor(across))
    if 0 <= line < shape[0] and 0 <= column < shape[1]:
        return line, column, z
    return -1, -1, z


@njit(cache=True, nogil=True)
def _plane_row(planes, optics, cell_px, T, p, row):
    """Write the Jacobian of a point's distance from the plane that it projects to, and return that distance.

    Args:
        planes: (R, C, 4) of the keyframe.
        optics: (9,) fx, fy, cx, cy, k1, k2, p1, p2, k3.
        cell_px: Edge of the cells.
        T: (4, 4) T_keyframe_camera.
        p: (3,) the point, camera frame.
        row: (6,) d distance / dδ for T_camera_world ← exp(δ) · T_camera_world; its end is minus the normal.

    Returns:
        The distance, negative in front of the plane; NaN if there is no plane.
    """
    line, column, z = cell_of(T, p, optics, cell_px, planes.shape)
    if line < 0:
        return np.nan
    plane = planes[line, column]
    if plane[3] == 0.0:
        return np.nan
    mx = T[0, 0] * plane[0] + T[1, 0] * plane[1] + T[2, 0] * plane[2]
    my = T[0, 1] * plane[0] + T[1, 1] * plane[1] + T[2, 1] * plane[2]
    mz = T[0, 2] * plane[0] + T[1, 2] * plane[1] + T[2, 2] * plane[2]
    row[0], row[1], row[2] = mz * p[1] - my * p[2], mx * p[2] - mz * p[0], my * p[0] - mx * p[1]
    row[0], row[1], row[2] = -row[0], -row[1], -row[2]
    row[3], row[4], row[5] = -mx, -my, -mz
    x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
    y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
    return plane[0] * x + plane[1] * y + plane[2] * z - plane[3]


@njit(cache=True, nogil=True)
def _sigma_m(row, p, sigmas):
    """Return the standard deviation of a point's distance from a plane: of its depth, and across its ray."""
    along = (row[3] * p[0] + row[4] * p[1] + row[5] * p[2]) / p[2] * sigmas[0]
    return np.sqrt(along * along + sigmas[1] * sigmas[1])


@njit(cache=True, nogil=True)
def _add_landmarks(T, points, measured, weights, intrinsics, active, H, g):
    """Add the normal equations of landmarks with Huber's kernel."""
    r, J, J_pose = np.empty(3), np.empty((3, 3)), np.empty((3, 6))
    for n in range(len(points)):
        if not active[n]:
            continue
        has_depth = linearise(T, points[n], measured[n], intrinsics, r, J, J_pose)
        scale, _ = huber(chi2(r, weights[n]), has_depth)
        for i in range(3):
            w = scale * weights[n, i]
            for a in range(6):
                g[a] += w * J_pose[i, a] * r[i]
                for b in range(6):
                    H[a, b] += w * J_pose[i, a] * J_pose[i, b]


@njit(cache=True, nogil=True)
def _projected(kept, H, g):
    """Return keptᵀ · H · kept and keptᵀ · g."""
    H_kept, g_kept = np.zeros((6, 6)), np.zeros(6)
    for a in range(6):
        for i in range(6):
            g_kept[a] += kept[i, a] * g[i]
            for b in range(6):
                for j in range(6):
                    H_kept[a, b] += kept[i, a] * H[i, j] * kept[j, b]
    return H_kept, g_kept


@njit(cache=True, nogil=True)
def descend(
    T_camera_world,
    T_prior,
    prior,
    points,
    sigmas,
    planes,
    T_keyframes_world,
    optics,
    cell_px,
    kept,
    gates_m,
    every,
    iterations,
    landmarks,
    measured,
    weights,
    intrinsics,
):
    """Return T_camera_world that fits planes, landmarks and a prediction, and which landmarks agree with it.

    Args:
        T_camera_world: (4, 4) to begin with.
        T_prior: (4, 4) the prediction.
        prior: (6, 6) its information.
        points: (N, 3) of the depth image, camera frame.
        sigmas: (N, 2) standard deviations of their depth and across their ray, metres.
        planes: (K, R, C, 4) of keyframes' depth images.
        T_keyframes_world: (K, 4, 4).
        optics: (9,) fx, fy, cx, cy, k1, k2, p1, p2, k3 of all depth images.
        cell_px: Edge of their cells.
        kept: (6, 6) projection of tangents to the motions that planes may decide.
        gates_m: (G,) largest distances from a plane, from coarse to fine.
        every: (G,) with each of these, one point in this number is used.
        iterations: Largest number of steps at each of these.
        landmarks: (L, 3) world.
        measured: (L, 3) u, v, bf/z.
        weights: (L, 3) inverse variances of these.
        intrinsics: (5,) fx, fy, cx, cy, bf.
    """
    T = T_camera_world.copy()
    active = np.ones(len(landmarks), np.bool_)
    row = np.empty(6)
    shared = _INDEPENDENT / (len(planes) + 1.0)
    for gate_m, stride in zip(gates_m, every):  # noqa: B905 – numba
        for _ in range(iterations):
            H, g = np.zeros((6, 6)), np.zeros(6)
            for k in range(len(planes)):
                T_k_c = between(T_keyframes_world[k], T)
                for i in range(0, len(points), stride):
                    distance = _plane_row(planes[k], optics, cell_px, T_k_c, points[i], row)
                    if not abs(distance) <= gate_m:
                        continue
                    sigma = _sigma_m(row, points[i], sigmas[i])
                    w = shared / (sigma * max(sigma, abs(distance) / _HUBER))
                    for a in range(6):
                        wa = w * row[a]
                        g[a] -= wa * distance
                        for b in range(a, 6):
                            H[a, b] += wa * row[b]
            for a in range(6):
                for b in range(a):
                    H[a, b] = H[b, a]
            H, g = _projected(kept, H, g)
            _add_landmarks(T, landmarks, measured, weights, intrinsics, active, H, g)
            D = between(T_prior, T)
            to_prior = np.empty(6)
            to_prior[0], to_prior[1] = 0.5 * (D[2, 1] - D[1, 2]), 0.5 * (D[0, 2] - D[2, 0])
            to_prior[2] = 0.5 * (D[1, 0] - D[0, 1])
            to_prior[3:] = D[:3, 3]
            for a in range(6):
                for b in range(6):
                    H[a, b] += prior[a, b]
                    g[a] += prior[a, b] * to_prior[b]
            step = solve_positive(H, g)
            T = twist_exp(step, T)
            if np.abs(step).max() < _STEP:
                break
        classify(T, landmarks, measured, weights, intrinsics, active)
    return T, active


@njit(cache=True, nogil=True)
def compare(T_camera_world, points, sigmas, planes, T_keyframes_world, optics, cell_px):
    """Return how a depth image fits keyframes' planes; arguments as for ``descend``.

    Returns:
        (N,) int8 of each point: −1 it lies in front of a keyframe's plane, else 1 it agrees with one, 0 it is
        hidden from all, or beside them. What moves can agree with the last keyframe, but not with all.
        (K,) number of points that agree with each keyframe.
        (6, 6) information of unit distances, and of distances in their standard deviations.
        (3, 3) sums of m·mᵀ over the normals m of all pairs, and of those that agree, camera frame.
        Sum of the squares of the agreeing distances in standard deviations, and in metres.
    """
    verdict = np.zeros(len(points), np.int8)
    agreeing = np.zeros(len(planes), np.int64)
    U, H = np.zeros((6, 6)), np.zeros((6, 6))
    facing, facing_agreeing = np.zeros((3, 3)), np.zeros((3, 3))
    row = np.empty(6)
    squares = squares_m = 0.0
    shared = _INDEPENDENT / (len(planes) + 1.0)
    for k in range(len(planes)):
        T_k_c = between(T_keyframes_world[k], T_camera_world)
        for i in range(len(points)):
            distance = _plane_row(planes[k], optics, cell_px, T_k_c, points[i], row)
            if np.isnan(distance):
                continue
            sigma = _sigma_m(row, points[i], sigmas[i])
            agrees = abs(distance) <= _MARGIN_M + _MARGIN_SIGMAS * sigma
            if distance > 0.0 and not agrees:
                continue  # hidden from the keyframe
            for a in range(3):
                for b in range(3):
                    facing[a, b] += row[3 + a] * row[3 + b]
                    if agrees:
                        facing_agreeing[a, b] += row[3 + a] * row[3 + b]
            if not agrees:
                verdict[i] = -1
                continue
            if verdict[i] != -1:
                verdict[i] = 1
            agreeing[k] += 1
            squares += distance * distance / (sigma * sigma)
            squares_m += distance * distance
            w = shared / (sigma * sigma)
            for a in range(6):
                for b in range(a, 6):
                    value = row[a] * row[b]
                    U[a, b] += value
                    H[a, b] += w * value
    for a in range(6):
        for b in range(a):
            U[a, b], H[a, b] = U[b, a], H[b, a]
    return verdict, agreeing, U, H, facing, facing_agreeing, squares, squares_m


@njit(cache=True, nogil=True)
def seen_through(T_camera_world, inverse_depth, planes, rays, T_keyframes_world, optics, cell_px, noise):
    """Return how many cells of keyframes a depth image sees through, and how many it sees at all.

    Args:
        T_camera_world: (4, 4) of the depth image.
        inverse_depth: (R, C) of its cells, 0 where there is none.
        planes: (K, R, C, 4) of the keyframes.
        rays: (R, C, 2) of all cells.
        T_keyframes_world: (K, 4, 4).
        optics: As for ``descend``.
        cell_px: Edge of the cells.
        noise: (3,) a, b, c of σ_z = a + b·z + c·z².
    """
    rows, columns = inverse_depth.shape
    through = seen = 0
    for k in range(len(planes)):
        T = between(T_camera_world, T_keyframes_world[k])
        for i in range(rows):
            for j in range(columns):
                plane = planes[k, i, j]
                u, v = rays[i, j, 0], rays[i, j, 1]
                facing = plane[0] * u + plane[1] * v + plane[2]
                if facing <= 0.0:
                    continue
                z = plane[3] / facing
                line, column, depth_m = cell_of(T, (u * z, v * z, z), optics, cell_px, inverse_depth.shape)
                if line < 1 or column < 1 or line >= rows - 1 or column >= columns - 1:
                    continue
                nearest = 0.0  # as inverse depth, about the cell
                for a in range(line - 1, line + 2):
                    for b in range(column - 1, column + 2):
                        nearest = max(nearest, inverse_depth[a, b])
                if inverse_depth[line, column] == 0.0:
                    continue
                seen += 1
                sigma_m = noise[0] + depth_m * (noise[1] + depth_m * noise[2])
                through += 1.0 / nearest > depth_m + 2.0 * _MARGIN_M + _MARGIN_SIGMAS * sigma_m
    return through, seen
