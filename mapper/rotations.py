"""Quaternions (always xyzw) and Euler angles, which live only in files and on screens."""

import numpy as np

from mapper.errors import DataError
from mapper.geometry import Array

_GIMBAL_SINE = 1.0 - 1e-12


def rotation_from_quaternion(xyzw: Array) -> Array:
    """Return the (3, 3) rotation of an xyzw quaternion of any positive length.

    Raises:
        DataError: The quaternion is zero or not finite.
    """
    norm = float(np.linalg.norm(xyzw))
    if not np.isfinite(norm) or norm < 1e-9:
        raise DataError(
            f"quaternion {tuple(map(float, xyzw))} has no direction; want a finite, non-zero xyzw"
        )
    x, y, z, w = np.asarray(xyzw) / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(R: Array) -> Array:
    """Return the unit xyzw quaternion, w ≥ 0, of a (3, 3) rotation (Shepperd 1978)."""
    trace = float(np.trace(R))
    choices = np.array([R[0, 0], R[1, 1], R[2, 2], trace])
    largest = int(np.argmax(choices))
    if largest == 3:
        q = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1.0 + trace])
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q = np.empty(4)
        q[i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        q[j] = R[j, i] + R[i, j]
        q[k] = R[k, i] + R[i, k]
        q[3] = R[k, j] - R[j, k]
    q /= np.linalg.norm(q)
    return -q if q[3] < 0.0 else q


def rotation_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """Return Rz(yaw) · Ry(pitch) · Rx(roll) (thesis eq. 2.19–2.22)."""
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

    At gimbal lock (pitch = ±π/2) only roll ∓ yaw is defined: roll is set to 0 (thesis eq. 2.29–2.33).
    """
    sine = float(np.clip(-R[2, 0], -1.0, 1.0))
    pitch = float(np.arcsin(sine))
    if abs(sine) >= _GIMBAL_SINE:
        return 0.0, pitch, float(np.arctan2(-R[0, 1], R[1, 1]))
    return float(np.arctan2(R[2, 1], R[2, 2])), pitch, float(np.arctan2(R[1, 0], R[0, 0]))
