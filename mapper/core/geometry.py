"""Rigid motions as (4, 4) float64 arrays, and the closed-form rigid fit.

``T_a_b`` maps points of frame b to frame a and is the pose of b in a, so inner names cancel:
``T_a_c = T_a_b @ T_b_c``. Tangent vectors are ordered (rotation, translation).
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapper.core.errors import DataError

Array = NDArray[np.float64]
Transform = NDArray[np.float64]
"""(4, 4) float64 rigid motion."""
Points = NDArray[np.float64]
"""(N, 3) float64 positions in metres; the variable's suffix names the frame."""

_SMALL_ANGLE_RAD = 1e-7
FARTHEST_M = 1e9
"""Beyond any place that a sensor gets to or an octree reaches, and a number that can be squared."""


def transform(R_a_b: Array, t_a_b: Array) -> Transform:
    """Return T_a_b from a (3, 3) rotation and a (3,) translation in metres, or (N, 4, 4) from N of both."""
    T_a_b = np.zeros((*np.shape(R_a_b)[:-2], 4, 4))
    T_a_b[..., :3, :3] = R_a_b
    T_a_b[..., :3, 3] = t_a_b
    T_a_b[..., 3, 3] = 1.0
    return T_a_b


def planar_motion(dx_m: float, dy_m: float, alpha_rad: float) -> Transform:
    """Return the (4, 4) motion that turns by α about z and then moves by (dx, dy)."""
    cosine, sine = np.cos(alpha_rad), np.sin(alpha_rad)
    R = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return transform(R, np.array([dx_m, dy_m, 0.0]))


def inverse(T_a_b: Transform) -> Transform:
    """Return T_b_a, using R⁻¹ = Rᵀ rather than a general matrix inverse."""
    R_b_a = T_a_b[:3, :3].T
    return transform(R_b_a, -R_b_a @ T_a_b[:3, 3])


def point_rows(points: ArrayLike, owner: str) -> tuple[tuple[int, ...], Points]:
    """Return the shape of (..., 3) points without the last axis, and the points as contiguous (N, 3) float64.

    Args:
        points: Anything that numpy takes for an array.
        owner: Name of what they are given to, for the error.

    Raises:
        DataError: They are not numbers, or the last axis is not 3.
    """
    try:
        array = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{owner}: points are no array of numbers: {error}") from None
    if array.ndim == 0 or array.shape[-1] != 3:
        raise DataError(f"{owner}: points {array.shape}, want (..., 3)")
    return array.shape[:-1], np.ascontiguousarray(array.reshape(-1, 3))


def apply(T_a_b: Transform, points_b: Points) -> Points:
    """Return the (N, 3) points of frame b in frame a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def distances_along(points: Array) -> Array:
    """Return (N,) metres from the first of (N, D) points to each, along the straight lines between them."""
    steps_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def path_length(points: Array) -> float:
    """Return the length of the straight lines between consecutive (N, D) points, in their own unit."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def skew(v: Array) -> Array:
    """Return the (3, 3) matrix with ``skew(v) @ w == cross(v, w)``."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_exp(rotation_rad: Array) -> Array:
    """Return the (3, 3) rotation of a (3,) rotation vector in radians (Rodrigues 1840)."""
    angle = math.sqrt(np.dot(rotation_rad, rotation_rad))
    K = skew(rotation_rad)
    if angle < _SMALL_ANGLE_RAD:
        return np.eye(3) + K + 0.5 * K @ K
    a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    R: Array = np.eye(3) + a * K + b * K @ K
    return R


def turn_to_z(up: Array) -> Array:
    """Return the (3, 3) rotation that takes a unit vector to z without turning about z (Rodrigues 1840)."""
    x, y, z = up
    K = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    R: Array = np.eye(3) + K + K @ K / (1.0 + z)
    return R


def rotation_log(R: Array) -> Array:
    """Return the (3,) rotation vector, at most π long, of a (3, 3) rotation."""
    w = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = 0.5 * math.sqrt(w @ w), 0.5 * float(R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    angle = math.atan2(sine, cosine)
    if angle < _SMALL_ANGLE_RAD:
        return 0.5 * w
    if sine > 1e-6 or cosine > 0.0:
        axis: Array = w * (0.5 / sine)
    else:  # near π the antisymmetric part vanishes: the axis is the largest column of the symmetric part
        B: Array = 0.25 * (R + R.T) + 0.5 * np.eye(3)
        column = B[:, int(np.argmax(np.diag(B)))]
        axis = column * math.copysign(1.0 / float(np.linalg.norm(column)), float(column @ w))
    return axis * angle


def in_plane(T: Transform) -> Transform:
    """Return the motion (4, 4) in the plane of x and y that is nearest: its yaw, x and y."""
    return planar_motion(T[0, 3], T[1, 3], float(np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1])))


def exp(rotation_rad: Array, translation_m: Array) -> Transform:
    """Return the motion of a twist: the exponential map of SE(3) (Murray, Li & Sastry 1994, eq. 2.36)."""
    V = _left_jacobian(rotation_rad)
    return transform(rotation_exp(rotation_rad), V @ translation_m)


def log(T_a_b: Transform) -> tuple[Array, Array]:
    """Return the twist (rotation_rad (3,), translation_m (3,)) with ``exp(*log(T)) == T``."""
    rotation_rad, t = rotation_log(T_a_b[:3, :3]), T_a_b[:3, 3]
    angle = math.sqrt(np.dot(rotation_rad, rotation_rad))
    # The inverse left Jacobian in closed form, and its series at small angles (Barfoot 2017, eq. 7.76b).
    b = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / angle**2 if angle > 1e-4 else 1.0 / 12.0
    K = skew(rotation_rad)
    Kt = K @ t
    translation_m: Array = t - 0.5 * Kt + b * (K @ Kt)
    return rotation_rad, translation_m


def adjoint(T_a_b: Transform) -> Array:
    """Return the (6, 6) map of twists (rotation, translation) of b to a (Murray, Li & Sastry 1994, §2.4)."""
    R, t = T_a_b[:3, :3], T_a_b[:3, 3]
    adjoint_a_b = np.zeros((6, 6))
    adjoint_a_b[:3, :3] = adjoint_a_b[3:, 3:] = R
    adjoint_a_b[3:, :3] = skew(t) @ R
    return adjoint_a_b


def _left_jacobian(rotation_rad: Array) -> Array:
    angle = math.sqrt(np.dot(rotation_rad, rotation_rad))
    K = skew(rotation_rad)
    if angle < 1e-4:  # series: the closed form loses digits here
        return np.eye(3) + 0.5 * K + K @ K / 6.0
    a, b = 2.0 * (np.sin(0.5 * angle) / angle) ** 2, (angle - np.sin(angle)) / angle**3
    V: Array = np.eye(3) + a * K + b * K @ K
    return V


def interpolate(T_a_b: Transform, T_a_c: Transform, fraction: float) -> Transform:
    """Return the pose at a fraction between b and c: rotation on SO(3), position on the straight line."""
    R_b_c = T_a_b[:3, :3].T @ T_a_c[:3, :3]
    R = T_a_b[:3, :3] @ rotation_exp(fraction * rotation_log(R_b_c))
    return transform(R, (1.0 - fraction) * T_a_b[:3, 3] + fraction * T_a_c[:3, 3])


def angle_between(R_a: Array, R_b: Array) -> float:
    """Return the angle in radians, 0 … π, of the rotation that takes one to the other."""
    return angle_of(R_a.T @ R_b)


def angle_of(R: Array) -> float:
    """Return the angle of a rotation (3, 3) in radians, 0 … π."""
    return float(np.linalg.norm(rotation_log(R)))


def length_and_angle(T_a_b: Transform) -> tuple[float, float]:
    """Return how far a motion goes, in metres, and how far it turns, in radians, 0 … π."""
    return float(np.linalg.norm(T_a_b[:3, 3])), angle_of(T_a_b[:3, :3])


def nearest_rotation(M: Array) -> Array:
    """Return the rotations closest to (…, 3, 3) matrices in the Frobenius norm (Umeyama 1991, lemma)."""
    U, _, Vt = np.linalg.svd(M)
    U[..., 2] *= np.where(np.linalg.det(U) * np.linalg.det(Vt) < 0.0, -1.0, 1.0)[..., np.newaxis]
    R: Array = U @ Vt
    return R


def mean_pose(T_near: Transform, poses: Iterable[Transform], informations: Sequence[Array]) -> Transform:
    """Return the (4, 4) mean of poses by their (6, 6) information, in the tangent of a pose near them."""
    weighted = [
        information @ np.concatenate(log(inverse(T_near) @ T))
        for T, information in zip(poses, informations, strict=True)
    ]
    step = np.linalg.solve(np.sum(informations, axis=0), np.sum(weighted, axis=0))
    return T_near @ exp(step[:3], step[3:])


def mean_rotation(rotations: Iterable[Array], weights: Iterable[float]) -> Array:
    """Return the weighted chordal mean on SO(3) (Hartley et al. 2013, §5.3)."""
    total = np.zeros((3, 3))
    for R, weight in zip(rotations, weights, strict=True):
        total += weight * R
    return nearest_rotation(total)


def fit_rigid(target: Points, source: Points, *, with_scale: bool = False) -> tuple[Transform, float]:
    """Return the least-squares motion and scale that take source points to their target partners.

    Arun, Huang & Blostein 1987 with the determinant correction of Umeyama 1991 (eq. 40 to 43), which is
    right also when noise makes the plain solution a reflection.

    Args:
        target: (N, 3) points in the target frame, metres.
        source: (N, 3) partners in the source frame, metres.
        with_scale: Estimate Umeyama's similarity scale; otherwise it is 1.

    Returns:
        T_target_source and the scale s, with ``target ≈ s · R · source + t``.

    Raises:
        DataError: Fewer than three pairs, or shapes that differ.
    """
    if target.shape != source.shape or target.ndim != 2 or target.shape[0] < 3 or target.shape[1] != 3:
        raise DataError(f"rigid fit: got {target.shape} and {source.shape}, want two (N, 3) with N ≥ 3")
    target_mean, source_mean = target.mean(axis=0), source.mean(axis=0)
    source_centred = source - source_mean
    covariance = (target - target_mean).T @ source_centred / len(target)
    U, D, Vt = np.linalg.svd(covariance)
    S = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt)) or 1.0])
    R = (U * S) @ Vt
    scale = 1.0
    if with_scale:
        variance = float((source_centred**2).sum() / len(source))
        if variance <= 0.0:
            raise DataError("rigid fit: all source points coincide, so no scale exists; align with SE(3)")
        scale = float((D * S).sum() / variance)
    return transform(R, target_mean - scale * R @ source_mean), scale


def is_rigid(T: NDArray[np.float64], *, tolerance: float = 1e-5) -> bool:
    """Return whether a (4, 4) or (N, 4, 4) array consists of rigid motions, none by 10⁹ m or more."""
    T = np.asarray(T)
    if T.shape == (4, 4):
        return _is_rigid_rows(T.tolist(), tolerance)
    if T.shape[-2:] != (4, 4) or not (np.abs(T) < FARTHEST_M).all():
        return False
    R = T[..., :3, :3]
    orthogonal = (np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)) <= tolerance).all()
    proper = (np.linalg.det(R) > 0.0).all()
    affine = (np.abs(T[..., 3, :] - [0.0, 0.0, 0.0, 1.0]) <= tolerance).all()
    return bool(orthogonal and proper and affine)


def _is_rigid_rows(rows: list[list[float]], tolerance: float) -> bool:
    """Return the same for one motion: arrays take ten times as long, and every pose and factor is checked."""
    (a, b, c, x), (d, e, f, y), (g, h, i, z), (p, q, r, s) = rows
    products = (
        a * a + b * b + c * c - 1.0,
        d * d + e * e + f * f - 1.0,
        g * g + h * h + i * i - 1.0,
        a * d + b * e + c * f,
        a * g + b * h + c * i,
        d * g + e * h + f * i,
    )
    orthogonal = all(abs(product) <= tolerance for product in products)
    proper = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) > 0.0
    affine = all(abs(value) <= tolerance for value in (p, q, r, s - 1.0))
    return orthogonal and proper and affine and all(abs(value) < FARTHEST_M for value in (x, y, z))


def spread_indices(count: int, most: int) -> NDArray[np.intp]:
    """Return the indices of at most ``most`` of some rows, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(np.intp))


def stride_for(count: int, most: int) -> int:
    """Return the smallest step, from the first row on, at which at most ``most`` of the rows are taken."""
    return max(1, -(-count // most))
