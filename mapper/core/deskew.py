"""Deskewing: the points of a sweep are moved to where they would have been measured at the scan's stamp."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numba import njit

from mapper.core.frames import Scan
from mapper.core.geometry import Array, Transform, exp, inverse, log
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Twist:
    """A constant velocity, in the body's own axes.

    Attributes:
        rotation_radps: (3,) radians per second.
        translation_mps: (3,) metres per second.
    """

    rotation_radps: Array
    translation_mps: Array

    @classmethod
    def of(cls, vector: Array) -> Self:
        """Return the twist of a (6,) vector, rotation before translation."""
        return cls(vector[:3], vector[3:])

    @property
    def vector(self) -> Array:
        """(6,) rotation, rad/s, before translation, m/s."""
        return np.concatenate([self.rotation_radps, self.translation_mps])

    def over(self, duration_s: float) -> Transform:
        """Return T_before_after (4, 4), the motion of the body in a duration."""
        return exp(self.rotation_radps * duration_s, self.translation_mps * duration_s)


STILL = Twist(np.zeros(3), np.zeros(3))


def twist_between(T_world_before: Transform, T_world_after: Transform, *, duration_s: float) -> Twist:
    """Return the constant velocity from one pose to another."""
    rotation_rad, translation_m = log(inverse(T_world_before) @ T_world_after)
    return Twist(rotation_rad / duration_s, translation_m / duration_s)


def twist_at(trajectory: Trajectory, index: int) -> Twist:
    """Return the velocity at a pose of a trajectory, from the pose before it to the pose after it."""
    first, last = max(index - 1, 0), min(index + 1, len(trajectory) - 1)
    if first == last:
        return STILL
    duration_s = float(trajectory.stamps_ns[last] - trajectory.stamps_ns[first]) / NS_PER_S
    poses = trajectory.T_world_body
    return twist_between(poses[first], poses[last], duration_s=duration_s)


def deskewed(scan: Scan, twist: Twist) -> Scan:
    """Return the scan with all points moved to its stamp; without times per point, the scan itself.

    A point measured τ after the stamp moves by exp(τ·twist): constant velocity, as in KISS-ICP (Vizzo et al.
    2023, eq. 2).
    """
    if scan.times_s is None:
        return scan
    points_body = _moved(scan.points_body, scan.times_s, twist.rotation_radps, twist.translation_mps)
    return replace(scan, points_body=points_body, times_s=None)


@njit(cache=True, nogil=True)
def _moved(points, times_s, rotation_radps, translation_mps):  # type: ignore[no-untyped-def]
    """Return exp(τ·twist) applied to every point: R = I + a·[ω]× + b·[ω]×², t = τ·v + b·ω×v + c·ω×(ω×v)."""
    moved = np.empty_like(points)
    wx, wy, wz = rotation_radps
    vx, vy, vz = translation_mps
    speed = np.sqrt(wx * wx + wy * wy + wz * wz)
    for index in range(len(points)):
        x, y, z = points[index]
        t = times_s[index]
        angle = speed * t
        if abs(angle) < 1e-6:
            a, b, c = t, 0.5 * t * t, t * t * t / 6.0
        else:
            a = np.sin(angle) / speed
            b = (1.0 - np.cos(angle)) / (speed * speed)
            c = (t - a) / (speed * speed)
        # ω × p and ω × (ω × p), then the same of v.
        px, py, pz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
        qx, qy, qz = wy * pz - wz * py, wz * px - wx * pz, wx * py - wy * px
        ux, uy, uz = wy * vz - wz * vy, wz * vx - wx * vz, wx * vy - wy * vx
        sx, sy, sz = wy * uz - wz * uy, wz * ux - wx * uz, wx * uy - wy * ux
        moved[index, 0] = x + a * px + b * qx + t * vx + b * ux + c * sx
        moved[index, 1] = y + a * py + b * qy + t * vy + b * uy + c * sy
        moved[index, 2] = z + a * pz + b * qz + t * vz + b * uz + c * sz
    return moved
