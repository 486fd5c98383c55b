"""Uncertainty of triangulated points along the rays on which they lie."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points

_MIN_DEPTH_M = 0.1


def ray_slope(T_camera_world: Array, points_world: Points, rays_world: Array, intrinsics: Array) -> Array:
    """Return by how much (M, 3) u, v and bf/z of points change per metre along rays, in pixels.

    Args:
        T_camera_world: (4, 4) or (M, 4, 4).
        points_world: (M, 3) metres.
        rays_world: (M, 3) directions of any length but 0.
        intrinsics: (5,) fx, fy, cx, cy, bf.
    """
    rays = rays_world / np.linalg.norm(rays_world, axis=1, keepdims=True)
    R, t = T_camera_world[..., :3, :3], T_camera_world[..., :3, 3]
    point = (R @ points_world[..., np.newaxis])[..., 0] + t
    ray = (R @ rays[..., np.newaxis])[..., 0]
    z = np.maximum(point[:, 2:], _MIN_DEPTH_M)
    slope_px = intrinsics[:2] * (ray[:, :2] - point[:, :2] / z * ray[:, 2:]) / z
    return np.column_stack([slope_px, -intrinsics[4] * ray[:, 2:] / z**2])


def updated_ray_sigma_m(
    sigma_m: Array,
    rays_world: Array,
    poses: Array,
    points_world: Points,
    edges: NDArray[np.integer],
    measured: Array,
    weights: Array,
    intrinsics: Array,
) -> Array:
    """Return the (P,) standard deviations of points along their rays, by their observations from known poses.

    Args:
        sigma_m: (P,) as known before; 0 for points that were not triangulated, and stay so.
        rays_world: (P, 3) directions.
        poses: (K, 4, 4) T_camera_world.
        points_world: (P, 3) metres.
        edges: (E, 2) pose and point of each observation.
        measured: (E, 3) u, v, bf/z in pixels; NaN in the third column without depth.
        weights: (E, 3) inverse variances, px⁻².
        intrinsics: (5,) fx, fy, cx, cy, bf.
    """
    chosen = np.flatnonzero(sigma_m[edges[:, 1]] > 0.0)
    pose, point = edges[chosen].T
    slope = ray_slope(poses[pose], points_world[point], rays_world[point], intrinsics)
    slope[np.isnan(measured[chosen])] = 0.0
    information = np.bincount(point, (weights[chosen] * slope**2).sum(axis=1), minlength=len(sigma_m))
    updated: Array = sigma_m.copy()
    updated[information > 0.0] = information[information > 0.0] ** -0.5
    return updated
