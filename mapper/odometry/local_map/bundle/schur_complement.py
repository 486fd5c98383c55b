"""Damped step of a bundle adjustment through the Schur complement (Triggs et al. 2000, §6.1), compiled."""

from typing import NamedTuple

import numpy as np
from numba import njit

from mapper.core.geometry import Array
from mapper.core.linear import solve_positive, turned


class Blocks(NamedTuple):
    """Blocks of the normal equations.

    Attributes:
        Hcc: (C, 6, 6) of the cameras.
        bc: (C, 6) their gradient.
        Hpp: (P, 3, 3) of the points.
        bp: (P, 3) their gradient.
        W: (E, 6, 3) between camera and point of each edge.
    """

    Hcc: Array
    bc: Array
    Hpp: Array
    bp: Array
    W: Array


@njit(cache=True, nogil=True)
def empty_blocks(cameras, points, edges):
    """Return blocks to fill in; those between cameras and points are 0."""
    Hcc, bc = np.empty((cameras, 6, 6)), np.empty((cameras, 6))
    Hpp, bp = np.empty((points, 3, 3)), np.empty((points, 3))
    return Blocks(Hcc, bc, Hpp, bp, np.zeros((edges, 6, 3)))


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
def _camera_system(blocks, damping):
    """Return the damped equations of the cameras, (6C, 6C) and (6C,), with the points fixed."""
    Hcc, bc = blocks.Hcc, blocks.bc
    cameras = len(Hcc)
    S = np.zeros((6 * cameras, 6 * cameras))
    rhs = np.empty(6 * cameras)
    for f in range(cameras):
        for a in range(6):
            rhs[6 * f + a] = bc[f, a]
            for b in range(6):
                S[6 * f + a, 6 * f + b] = Hcc[f, a, b]
            S[6 * f + a, 6 * f + a] += damping * Hcc[f, a, a] + 1e-6
    return S, rhs


@njit(cache=True, nogil=True)
def _add_across(free, pairs, across, S):
    """Add the (6, 6) blocks between linked cameras to the upper triangle, which is copied to the lower."""
    for q in range(len(across)):
        f, g = free[pairs[q, 0]], free[pairs[q, 1]]
        if f >= 0 and g >= 0:
            for a in range(6):
                for b in range(6):
                    if f < g:
                        S[6 * f + b, 6 * g + a] += across[q, a, b]
                    else:
                        S[6 * g + a, 6 * f + b] += across[q, a, b]


@njit(cache=True, nogil=True)
def _eliminate_points(free, first_edge, edges, active, blocks, damping, S, rhs):
    """Reduce the cameras' equations to their Schur complement, and return the points' (P, 3, 3) inverses."""
    _, _, Hpp, bp, W = blocks
    points = len(Hpp)
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
    for i in range(len(S)):
        for j in range(i):
            S[i, j] = S[j, i]
    return inverses


@njit(cache=True, nogil=True)
def _back_substituted(free, first_edge, edges, active, blocks, inverses, step_cameras):
    """Return the points' step (P, 3) by that of the cameras (C, 6)."""
    bp, W = blocks.bp, blocks.W
    points = len(bp)
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
    return step_points


@njit(cache=True, nogil=True)
def damped_step(free, first_edge, edges, active, blocks, damping, pairs=None, across=None):
    """Return the damped step of cameras (C, 6) and points (P, 3) through the Schur complement.

    ``across`` (Q, 6, 6) are the blocks between linked cameras, ``pairs`` (Q, 2) their keyframes.
    """
    S, rhs = _camera_system(blocks, damping)
    if across is not None:
        _add_across(free, pairs, across, S)
    inverses = _eliminate_points(free, first_edge, edges, active, blocks, damping, S, rhs)
    step_cameras = solve_positive(S, rhs).reshape(len(blocks.Hcc), 6)
    return step_cameras, _back_substituted(free, first_edge, edges, active, blocks, inverses, step_cameras)
