"""Poses in the plane z = 0, and on a circle."""

import numpy as np

from mapper.core.geometry import exp, transform
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory


def at(x: float, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """Return the (4, 4) pose at x and y in metres, turned by yaw in radians."""
    return transform(exp(np.array([0.0, 0.0, yaw]), np.zeros(3))[:3, :3], np.array([x, y, 0.0]))


def on_a_circle(count: int, *, radius_m: float, rounds: int = 1) -> list[np.ndarray]:
    """Return poses along a circle about the origin, each 0.1 m higher a radian further."""
    angles_rad = np.linspace(0.0, 2.0 * np.pi * rounds, count, endpoint=False)
    return [
        exp(np.array([0.0, 0.0, angle_rad]), np.zeros(3))
        @ transform(np.eye(3), np.array([radius_m, 0.0, 0.1 * angle_rad]))
        for angle_rad in angles_rad
    ]


def arc(count: int, *, step_m: float = 0.5, turn_rad: float = 0.0) -> Trajectory:
    """Return poses of equal steps and turns, ten a second, the first at the origin."""
    T = [np.linalg.matrix_power(at(step_m, 0.0, turn_rad), k) for k in range(count)]
    return Trajectory(np.arange(count, dtype=np.int64) * NS_PER_S // 10, np.array(T))
