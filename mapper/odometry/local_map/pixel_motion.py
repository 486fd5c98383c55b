"""Motion of still points' pixels and depths in the image of a moving camera."""

import numpy as np

from mapper.core.geometry import Array


def pixel_velocity(pixels: Array, depth_m: Array, intrinsics: Array, twist_camera: Array) -> Array:
    """Return the (N, 2) velocity of still points' pixels, px/s (Longuet-Higgins & Prazdny 1980, eq. 2.9).

    Args:
        pixels: (N, 2) undistorted.
        depth_m: (N,) > 0.
        intrinsics: fx, fy, cx, cy in pixels, and more.
        twist_camera: (6,) the camera's velocity in its own axes: rotation rad/s, translation m/s.
    """
    rays = (pixels - intrinsics[2:4]) / intrinsics[:2]
    x, y = rays[:, 0], rays[:, 1]
    (wx, wy, wz), (vx, vy, vz) = twist_camera[:3], twist_camera[3:]
    along_row = x * y * wx - (1.0 + x * x) * wy + y * wz + (x * vz - vx) / depth_m
    along_column = (1.0 + y * y) * wx - x * y * wy - x * wz + (y * vz - vy) / depth_m
    return np.column_stack([along_row, along_column]) * intrinsics[:2]


def depth_velocity(pixels: Array, depth_m: Array, intrinsics: Array, twist_camera: Array) -> Array:
    """Return the (N,) velocity of still points' depths, m/s; arguments as for ``pixel_velocity``."""
    rays = (pixels - intrinsics[2:4]) / intrinsics[:2]
    velocity: Array = -twist_camera[5] - depth_m * (
        twist_camera[0] * rays[:, 1] - twist_camera[1] * rays[:, 0]
    )
    return velocity


def row_phase(pixels: Array, height_px: int) -> Array:
    """Return (N,) when a pixel's row is read relative to the middle row, as a share of the readout time."""
    phase: Array = (pixels[:, 1] + 0.5) / height_px - 0.5
    return phase
