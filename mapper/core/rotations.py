"""Conversions of rotations from and to quaternions (always xyzw) and Euler angles, as files have them."""

from itertools import permutations, product

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Array, transform

_GIMBAL_SINE = 1.0 - 1e-12


def rotation_from_quaternion(xyzw: Array) -> Array:
    """Return the (3, 3) rotation of an xyzw quaternion of any positive length, or (N, 3, 3) of (N, 4).

    Raises:
        DataError: A quaternion is zero, not finite, or so large that its length is not.
    """
    xyzw = np.asarray(xyzw)
    with np.errstate(over="ignore"):
        norm = np.sqrt((xyzw * xyzw).sum(axis=-1, keepdims=True))
    usable = np.isfinite(norm) & (norm >= 1e-9)
    if not usable.all():
        bad = np.atleast_2d(xyzw)[int(np.argmin(usable.ravel()))]
        raise DataError(f"quaternion {tuple(map(float, bad))} has no direction; want a finite, non-zero xyzw")
    x, y, z, w = (xyzw / norm).T
    columns = [
        [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
        [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
        [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(columns).T


def quaternion_from_rotation(R: Array) -> Array:
    """Return the unit xyzw quaternion, w ≥ 0, of a (3, 3) rotation, or (N, 4) of (N, 3, 3).

    Every row of 4 · q · qᵀ is the quaternion times a factor; the row with the largest factor loses no digits
    (Shepperd 1978).
    """
    (xx, yx, zx), (xy, yy, zy), (xz, yz, zz) = R.T
    rows = [
        [1 + xx - yy - zz, yx + xy, zx + xz, zy - yz],
        [yx + xy, 1 + yy - zz - xx, zy + yz, xz - zx],
        [zx + xz, zy + yz, 1 + zz - xx - yy, yx - xy],
        [zy - yz, xz - zx, yx - xy, 1 + (xx + yy + zz)],
    ]
    outer = np.array(rows).T
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q: Array = outer[largest] if R.ndim == 2 else outer[np.arange(len(outer)), largest]
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0.0, -q, q)


def pose_of_row(row: Array) -> Array:
    """Return the (4, 4) pose of ``x y z qx qy qz qw``, as files have poses, or (N, 4, 4) of (N, 7).

    Raises:
        DataError: As ``rotation_from_quaternion``.
    """
    return transform(rotation_from_quaternion(row[..., 3:]), row[..., :3])


def row_of_pose(T: Array) -> Array:
    """Return ``x y z qx qy qz qw`` of a (4, 4) pose, (7,), or (N, 7) of (N, 4, 4)."""
    return np.concatenate([T[..., :3, 3], quaternion_from_rotation(T[..., :3, :3])], axis=-1)


def rotation_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """Return Rz(yaw) · Ry(pitch) · Rx(roll) (Somlyai, PhD thesis, eq. 2.24–2.28)."""
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def euler_from_rotation(R: Array) -> tuple[float, float, float]:
    """Return (roll, pitch, yaw) in radians with ``rotation_from_euler(...) == R``.

    Somlyai (PhD thesis), eq. 2.29–2.31. At gimbal lock (pitch = ±π/2) only roll ∓ yaw is defined: roll is set
    to 0, where the thesis sets yaw to 0 (eq. 2.32, 2.33).
    """
    sine = float(np.clip(-R[2, 0], -1.0, 1.0))
    pitch = float(np.arcsin(sine))
    if abs(sine) >= _GIMBAL_SINE:
        return 0.0, pitch, float(np.arctan2(-R[0, 1], R[1, 1]))
    return float(np.arctan2(R[2, 1], R[2, 2])), pitch, float(np.arctan2(R[1, 0], R[0, 0]))


def right_angled_frames() -> list[Array]:
    """Return the 48 matrices (3, 3) that permute and flip axes; half of them are rotations."""
    frames = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[range(3), order] = signs
            frames.append(R)
    return frames
