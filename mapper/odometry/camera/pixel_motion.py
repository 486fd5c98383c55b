"""Motion of still points' pixels and depths in the image of a moving camera, compiled."""

import numpy as np
from numba import njit

from mapper.core.geometry import Array


@njit(cache=True, nogil=True)
def pixel_velocity(pixels, depth_m, intrinsics, twist_camera):
    """Return the (N, 2) velocity of still points' pixels, px/s (Longuet-Higgins & Prazdny 1980, eq. 2.9).

    Args:
        pixels: (N, 2) undistorted.
        depth_m: (N,) > 0.
        intrinsics: fx, fy, cx, cy in pixels, and more.
        twist_camera: (6,) the camera's velocity in its own axes: rotation rad/s, translation m/s.
    """
    wx, wy, wz, vx, vy, vz = twist_camera
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    velocity = np.empty((len(pixels), 2))
    for n in range(len(pixels)):
        x, y = (pixels[n, 0] - cx) / fx, (pixels[n, 1] - cy) / fy
        z = depth_m[n]
        velocity[n, 0] = fx * (x * y * wx - (1.0 + x * x) * wy + y * wz + (x * vz - vx) / z)
        velocity[n, 1] = fy * ((1.0 + y * y) * wx - x * y * wy - x * wz + (y * vz - vy) / z)
    return velocity


@njit(cache=True, nogil=True)
def depth_velocity(pixels, depth_m, intrinsics, twist_camera):
    """Return the (N,) velocity of still points' depths, m/s; arguments as for ``pixel_velocity``."""
    wx, wy, vz = twist_camera[0], twist_camera[1], twist_camera[5]
    velocity = np.empty(len(pixels))
    for n in range(len(pixels)):
        x = (pixels[n, 0] - intrinsics[2]) / intrinsics[0]
        y = (pixels[n, 1] - intrinsics[3]) / intrinsics[1]
        velocity[n] = -vz - depth_m[n] * (wx * y - wy * x)
    return velocity


def line_phase(pixels: Array, size_px: tuple[int, int]) -> Array:
    """Return (N,) when a pixel's line is read relative to the middle one, as a share of the readout time.

    Sensors read lines along their longer side: those of an upright image, turned after it was taken, are its
    columns.

    Args:
        pixels: (N, 2) columns and rows.
        size_px: Width and height of the image.
    """
    axis = 0 if size_px[0] < size_px[1] else 1
    phase: Array = (pixels[:, axis] + 0.5) / size_px[axis] - 0.5
    return phase
