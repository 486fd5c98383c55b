"""Depth images of an empty box, by intersecting rays with its walls, without any texture."""

import numpy as np

from mapper.core.frames import DepthImage, PinholeCamera, RgbdFrame, ray_table
from mapper.core.geometry import Transform, transform

CAMERA = PinholeCamera(160, 120, 131.0, 131.0, 79.5, 59.5)
CORNER = transform(
    np.array([[0.8, 0.12, 0.588], [-0.6, 0.16, 0.784], [0.0, -0.98, 0.199]]) @ np.eye(3), np.zeros(3)
)
"""T_world_camera in the middle of a room: two walls and a part of the ceiling are in view."""
CORNER[:3, :3] = np.linalg.svd(CORNER[:3, :3])[0] @ np.linalg.svd(CORNER[:3, :3])[2]


def box_depth(T_world_camera: Transform, half_m: tuple[float, float, float]) -> DepthImage:
    """Return the exact depth image inside a box about the world's origin, half_m from each of its walls."""
    rays = ray_table(CAMERA).astype(np.float64)
    directions = np.dstack([rays, np.ones(rays.shape[:2])]) @ T_world_camera[:3, :3].T
    with np.errstate(divide="ignore"):
        walls = (np.sign(directions) * half_m - T_world_camera[:3, 3]) / directions
    return walls.min(axis=2).astype(np.float32)


def white_frame(
    stamp_ns: int,
    T_world_camera: Transform,
    half_m: tuple[float, float, float],
    *,
    rng: np.random.Generator | None = None,
) -> RgbdFrame:
    """Return a frame inside the box with an evenly white image; with ``rng``, the depth noise of a Kinect."""
    depth_m = box_depth(T_world_camera, half_m)
    if rng is not None:
        sigma_m = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
        depth_m = (depth_m + sigma_m * rng.standard_normal(depth_m.shape)).astype(np.float32)
    return RgbdFrame(stamp_ns, np.full(depth_m.shape, 255, np.uint8), depth_m, CAMERA)
