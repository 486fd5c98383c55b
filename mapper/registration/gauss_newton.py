"""Gauss–Newton on pairs of points with uncertain positions, compiled without the interpreter's lock.

A step is a twist of the source about its own origin, seen along the target's axes: far from the target's
origin its rotation and its translation would otherwise be nearly one.
"""

import numpy as np
from numba import njit

from mapper.core.linear import solve_positive, twist_exp
from mapper.registration.kd_tree import STACK, search

POINT, PLANE, GAUSSIAN = range(3)
"""Distances that are minimised: between points, to planes (Chen & Medioni 1992), between Gaussians."""

FLATNESS = 1.0 - 1e-3
"""A surface's covariance is I − FLATNESS · n nᵀ: a thousandth as thick as wide (Segal et al. 2009)."""

_DAMPING = 1e-6
"""Per pair; along a direction that no plane observes the motion stays as it was."""


@njit(cache=True, nogil=True)
def descend_on_points(
    points, axes, cuts, normals, source_points, source_normals, T, kind, max_distance, iterations, steps
):
    """Return T_target_source after Gauss–Newton on the pairs that are nearest at each step.

    Args:
        points: (N, 3) of the target's tree.
        axes: The tree's.
        cuts: The tree's.
        normals: (N, 3) of the target.
        source_points: (M, 3).
        source_normals: (M, 3).
        T: (4, 4) T_target_source to begin with.
        kind: POINT, PLANE or GAUSSIAN.
        max_distance: Points without a partner this near are left out.
        iterations: Largest number of steps.
        steps: (2,) radians and metres; a shorter step is the last.
    """
    branches, offsets = np.empty((STACK, 3), np.int64), np.empty((STACK, 4))
    index, squared = np.zeros(1, np.int64), np.empty(1)
    p, m, n = np.empty(3), np.empty(3), np.empty(3)
    for _ in range(iterations):
        sums, pairs = np.zeros(27), 0
        for i in range(len(source_points)):
            move(T, source_points[i], p)
            squared[0] = max_distance * max_distance
            search(points, axes, cuts, p, index, squared, branches, offsets)
            if squared[0] == max_distance * max_distance:
                continue
            pairs += 1
            partner = index[0]
            turn(T, source_normals[i], m)
            for k in range(3):
                n[k] = normals[partner, k]
            if kind == POINT:
                weight = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
            elif kind == PLANE:
                weight = (n[0] * n[0], n[0] * n[1], n[0] * n[2], n[1] * n[1], n[1] * n[2], n[2] * n[2])
            else:
                weight = inverse_of(
                    2.0 - FLATNESS * (n[0] * n[0] + m[0] * m[0]),
                    -FLATNESS * (n[0] * n[1] + m[0] * m[1]),
                    -FLATNESS * (n[0] * n[2] + m[0] * m[2]),
                    2.0 - FLATNESS * (n[1] * n[1] + m[1] * m[1]),
                    -FLATNESS * (n[1] * n[2] + m[1] * m[2]),
                    2.0 - FLATNESS * (n[2] * n[2] + m[2] * m[2]),
                )
            for k in range(3):
                n[k] = points[partner, k] - p[k]
            add_pair(sums, T, p, n[0], n[1], n[2], weight)
        T, is_last = gauss_newton_step(sums, pairs, T, steps)
        if is_last:
            break
    return T


@njit(cache=True, nogil=True)
def move(T, point, out):
    """Write T · point."""
    for k in range(3):
        out[k] = T[k, 0] * point[0] + T[k, 1] * point[1] + T[k, 2] * point[2] + T[k, 3]


@njit(cache=True, nogil=True)
def turn(T, direction, out):
    """Write R · direction."""
    for k in range(3):
        out[k] = T[k, 0] * direction[0] + T[k, 1] * direction[1] + T[k, 2] * direction[2]


@njit(cache=True, nogil=True)
def inverse_of(xx, xy, xz, yy, yz, zz):
    """Return the inverse of a symmetric positive definite matrix by its cofactors."""
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    scale = 1.0 / (xx * a + xy * b + xz * c)
    return (
        a * scale,
        b * scale,
        c * scale,
        (xx * zz - xz * xz) * scale,
        (xy * xz - xx * yz) * scale,
        (xx * yy - xy * xy) * scale,
    )


@njit(cache=True, nogil=True)
def add_pair(sums, T, p, x, y, z, weight):
    """Add a pair's JᵀWJ (upper triangle, row by row) and JᵀWr to 27 sums.

    The residual r is (x, y, z), from p to its partner. With u from the source's origin to p, it changes by
    u × ω − v: J = [U, −I], and A = W·U.
    """
    xx, xy, xz, yy, yz, zz = weight
    ux, uy, uz = p[0] - T[0, 3], p[1] - T[1, 3], p[2] - T[2, 3]
    a00, a10, a20 = xy * uz - xz * uy, yy * uz - yz * uy, yz * uz - zz * uy
    a01, a11, a21 = xz * ux - xx * uz, yz * ux - xy * uz, zz * ux - xz * uz
    a02, a12, a22 = xx * uy - xy * ux, xy * uy - yy * ux, xz * uy - yz * ux
    wx, wy, wz = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z
    sums[0] += uz * a10 - uy * a20
    sums[1] += uz * a11 - uy * a21
    sums[2] += uz * a12 - uy * a22
    sums[3] -= a00
    sums[4] -= a10
    sums[5] -= a20
    sums[6] += ux * a21 - uz * a01
    sums[7] += ux * a22 - uz * a02
    sums[8] -= a01
    sums[9] -= a11
    sums[10] -= a21
    sums[11] += uy * a02 - ux * a12
    sums[12] -= a02
    sums[13] -= a12
    sums[14] -= a22
    sums[15] += xx
    sums[16] += xy
    sums[17] += xz
    sums[18] += yy
    sums[19] += yz
    sums[20] += zz
    sums[21] += uz * wy - uy * wz
    sums[22] += ux * wz - uz * wx
    sums[23] += uy * wx - ux * wy
    sums[24] -= wx
    sums[25] -= wy
    sums[26] -= wz


@njit(cache=True, nogil=True)
def gauss_newton_step(sums, pairs, T, steps):
    """Return T after one step of Gauss–Newton, and whether the step was short enough to be the last."""
    H, g = np.empty((6, 6)), np.empty(6)
    k = 0
    for i in range(6):
        for j in range(i, 6):
            H[i, j] = H[j, i] = sums[k]
            k += 1
        H[i, i] += _DAMPING * (1.0 + pairs)
        g[i] = -sums[21 + i]
    step = solve_positive(H, g)
    about_source = T.copy()
    about_source[:3, 3] = 0.0
    moved = twist_exp(step, about_source)
    moved[:3, 3] += T[:3, 3]
    turned = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    shifted = np.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
    return moved, turned < steps[0] and shifted < steps[1]
