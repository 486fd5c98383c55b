"""Poses in the plane z = 0, and on a circle."""

import numpy as np

from mapper.core.geometry import exp, transform


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
