"""Poses in the plane z = 0."""

import numpy as np

from mapper.core.geometry import exp, transform


def at(x: float, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """Return the (4, 4) pose at x and y in metres, turned by yaw in radians."""
    return transform(exp(np.array([0.0, 0.0, yaw]), np.zeros(3))[:3, :3], np.array([x, y, 0.0]))
