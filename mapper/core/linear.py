"""Small dense linear algebra, compiled without BLAS: numba's own needs SciPy and is no faster here."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def product(A, B):
    """Return the product of two (3, 3) matrices, or of the (3, 3) corners of larger ones."""
    C = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return C


@njit(cache=True, nogil=True)
def turned(A, v):
    """Return the (3,) product of a (3, 3) matrix with a (3,) vector."""
    w = np.empty(3)
    for i in range(3):
        w[i] = A[i, 0] * v[0] + A[i, 1] * v[1] + A[i, 2] * v[2]
    return w


@njit(cache=True, nogil=True)
def between(T_a_w, T_b_w):
    """Return T_a_b of two poses (4, 4) of the world."""
    T = np.eye(4)
    T[:3, :3] = product(T_a_w, T_b_w[:3, :3].T.copy())
    T[:3, 3] = T_a_w[:3, 3] - turned(T, T_b_w[:3, 3])
    return T


@njit(cache=True, nogil=True)
def gram(A, B):
    """Return the (K, L) product AᵀB of (N, K) and (N, L), summed in the same order with any BLAS."""
    rows, columns = A.shape[1], B.shape[1]
    C = np.zeros((rows, columns))
    for n in range(len(A)):
        for i in range(rows):
            for j in range(columns):
                C[i, j] += A[n, i] * B[n, j]
    return C


@njit(cache=True, nogil=True)
def solve_positive(A, b):
    """Return x with A x = b by Cholesky's factorisation; zeros where A (N, N) is not positive definite.

    An optimiser then takes a step of zero.
    """
    n = len(b)
    L = np.empty((n, n))
    x = np.zeros(n)
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = total / L[j, j]
            elif total > 0.0:
                L[i, i] = np.sqrt(total)
            else:
                return x
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= L[i, k] * x[k]
        x[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= L[k, i] * x[k]
        x[i] = total / L[i, i]
    return x


@njit(cache=True, nogil=True)
def twist_exp(delta, T):
    """Return exp(δ) · T for a (6,) twist (rotation, translation) and a (4, 4) motion."""
    wx, wy, wz = delta[0], delta[1], delta[2]
    K = np.array([[0.0, -wz, wy], [wz, 0.0, -wx], [-wy, wx, 0.0]])
    angle = np.sqrt(wx * wx + wy * wy + wz * wz)
    if angle < 1e-8:
        a, b, c = 1.0, 0.5, 1.0 / 6.0
    else:
        a = np.sin(angle) / angle
        b = (1.0 - np.cos(angle)) / angle**2
        c = (angle - np.sin(angle)) / angle**3
    KK = product(K, K)
    R = np.eye(3) + a * K + b * KK
    V = np.eye(3) + b * K + c * KK
    moved = np.eye(4)
    moved[:3, :3] = product(R, T)
    moved[:3, 3] = turned(R, T[:3, 3]) + turned(V, delta[3:])
    # Products of many small rotations drift off SO(3): a Gram–Schmidt step restores them.
    for i in range(3):
        for j in range(i):
            dot = 0.0
            for k in range(3):
                dot += moved[i, k] * moved[j, k]
            for k in range(3):
                moved[i, k] -= dot * moved[j, k]
        norm = np.sqrt(moved[i, 0] ** 2 + moved[i, 1] ** 2 + moved[i, 2] ** 2)
        for k in range(3):
            moved[i, k] /= norm
    return moved


@njit(cache=True, nogil=True)
def rodrigues(squared):
    """Return the factors sin(θ) / θ and (1 − cos(θ)) / θ² of Rodrigues' formula for θ²."""
    if squared < 1e-16:
        return 1.0, 0.5
    angle = np.sqrt(squared)
    return np.sin(angle) / angle, (1.0 - np.cos(angle)) / squared


@njit(cache=True, nogil=True)
def rotation_of(vector):
    """Return the (3, 3) rotation of a (3,) rotation vector (Rodrigues' formula), for compiled code."""
    x, y, z = vector
    a, b = rodrigues(x * x + y * y + z * z)
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    R[1, 0], R[1, 1], R[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    R[2, 0], R[2, 1], R[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    return R
