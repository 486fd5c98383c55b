"""A corner of three walls, and exact depth images of it."""

import numpy as np

from mapper.core.frames import PinholeCamera
from mapper.core.geometry import inverse

CAMERA = PinholeCamera(320, 240, 262.0, 260.0, 159.5, 119.5)
INTRINSICS = np.array([262.0, 260.0, 159.5, 119.5, 40.0])
NORMALS = np.array([[0.3, 0.1, 1.0], [-0.8, 0.2, 0.6], [0.1, 0.9, 0.4]])
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
HEIGHTS_M = np.array([2.5, 1.6, 1.2])
"""Of the walls, n · x = h, in the world."""


def inverse_depth(T_camera_world, pixels):
    """Return 1 / z of the walls at pixels, exactly."""
    rays = np.column_stack([(pixels - INTRINSICS[2:4]) / INTRINSICS[:2], np.ones(len(pixels))])
    T_world_camera = inverse(T_camera_world)
    heights_m = HEIGHTS_M - NORMALS @ T_world_camera[:3, 3]
    return (rays @ T_world_camera[:3, :3].T @ NORMALS.T / heights_m).max(axis=1)


def depth_image(T_camera_world, *, factor=1.0, shift=(0.0, 0.0)):
    """Return the depth image, by a camera of ``factor`` times the focal length, shifted by shares of ours."""
    columns, rows = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    shift_px = np.array(shift) * INTRINSICS[:2]
    seen = INTRINSICS[2:4] + (pixels - INTRINSICS[2:4] - shift_px) / factor
    return (1.0 / inverse_depth(T_camera_world, seen)).astype(np.float32).reshape(columns.shape)
