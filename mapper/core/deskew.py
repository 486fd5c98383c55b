"""Deskewing: the points of a sweep are moved to where they would have been measured at the scan's stamp."""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.frames import Points32, Scan
from mapper.core.geometry import Array, Transform, exp, inverse, log, rotation_log
from mapper.core.linear import rodrigues, rotation_of
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

    def about(self, _moment_s: float) -> Self:
        """Return the same motion with time counted from another moment."""
        return self


STILL = Twist(np.zeros(3), np.zeros(3))


@dataclass(frozen=True, slots=True, eq=False)
class SampledMotion:
    """A rotation that was measured at some times, as by a gyroscope, and a constant velocity in the world.

    Attributes:
        times_s: (K,) increasing, K ≥ 2; the body's own axes are those at time 0.
        R: (K, 3, 3) rotation of the body at these times, in its axes at time 0.
        translation_mps: (3,) metres per second, in its axes at time 0.
    """

    times_s: Array
    R: Array
    translation_mps: Array

    def over(self, duration_s: float) -> Transform:
        """Return T_before_after (4, 4), the motion of the body from time 0 on."""
        T = np.eye(4)
        T[:3, :3] = _rotation_at(self.times_s, self.R, self._rates(), duration_s)
        T[:3, 3] = duration_s * self.translation_mps
        return T

    def about(self, moment_s: float) -> "SampledMotion":
        """Return the same motion with time counted from another moment, in the body's axes then."""
        R_moment = self.over(moment_s)[:3, :3].T
        return SampledMotion(self.times_s - moment_s, R_moment @ self.R, R_moment @ self.translation_mps)

    def move(self, points: Points32, times_s: NDArray[np.float32]) -> Points32:
        """Return (N, 3) points, each measured at its own time, as of time 0."""
        moved: Points32 = _moved_by_samples(
            points, times_s, self.times_s, self.R, self._rates(), self.translation_mps
        )
        return moved

    def _rates(self) -> Array:
        """Return the (K - 1, 3) angular velocity after each time but the last."""
        turns = [rotation_log(before.T @ after) for before, after in pairwise(self.R)]
        return np.array(turns) / np.diff(self.times_s)[:, None]


Motion = Twist | SampledMotion
"""Motion of the body during a sweep."""


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


def deskewed(scan: Scan, motion: Motion) -> Scan:
    """Return the scan with all points moved to its stamp; without times per point, the scan itself.

    A point measured τ after the stamp moves by exp(τ·twist) under a constant velocity, as in KISS-ICP (Vizzo
    et al. 2023, eq. 2), and by the rotation at τ and τ times the velocity where the rotation was measured.
    """
    if scan.times_s is None:
        return scan
    if isinstance(motion, SampledMotion):
        return replace(scan, points_body=motion.move(scan.points_body, scan.times_s), times_s=None)
    points_body = _moved(scan.points_body, scan.times_s, motion.rotation_radps, motion.translation_mps)
    return replace(scan, points_body=points_body, times_s=None)


@njit(cache=True, nogil=True)
def _moved(points, times_s, rotation_radps, translation_mps):
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


@njit(cache=True, nogil=True)
def _rotation_at(times_s, R, rates_radps, time_s):
    """Return the (3, 3) rotation at a time; the angular velocity is constant between two samples."""
    k = min(max(np.searchsorted(times_s, time_s, side="right") - 1, 0), len(rates_radps) - 1)
    return R[k] @ rotation_of(rates_radps[k] * (time_s - times_s[k]))


@njit(cache=True, nogil=True)
def _moved_by_samples(points, point_times_s, times_s, R, rates_radps, translation_mps):
    """Return R(τ)·p + τ·v of every point, R(τ) = R[k] · exp((τ − t_k)·ω_k) from the sample k before τ on."""
    moved = np.empty_like(points)
    k, last = 0, len(rates_radps) - 1
    for index in range(len(points)):
        t = float(point_times_s[index])
        while k < last and times_s[k + 1] <= t:  # points lie in the order of time, or in that of rings
            k += 1
        while k > 0 and times_s[k] > t:
            k -= 1
        since_s = t - times_s[k]
        wx, wy, wz = since_s * rates_radps[k, 0], since_s * rates_radps[k, 1], since_s * rates_radps[k, 2]
        a, b = rodrigues(wx * wx + wy * wy + wz * wz)
        x, y, z = points[index]
        px, py, pz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
        x += a * px + b * (wy * pz - wz * py)
        y += a * py + b * (wz * px - wx * pz)
        z += a * pz + b * (wx * py - wy * px)
        for i in range(3):
            moved[index, i] = R[k, i, 0] * x + R[k, i, 1] * y + R[k, i, 2] * z + t * translation_mps[i]
    return moved
