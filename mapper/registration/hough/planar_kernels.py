"""Compiled loops of the planar refinement: a volume of obstacles, and the overlap of points with it."""

import numpy as np
from numba import njit
from numpy import int64, uint8

FULL_OVERLAP = 4
"""Weight of a point in an occupied voxel, less one for each axis along which it lies beside one."""


@njit(cache=True, nogil=True)
def draw_volume(obstacles, heights, voxel_m, edge, low_m, layers):
    """Return (layers, edge, edge) uint8: ``FULL_OVERLAP`` where obstacles are, less in the voxels around.

    Args:
        obstacles: (N, 3) of which x and y are used, within edge · voxel_m / 2 of 0.
        heights: (N,) above the ground, the third coordinate.
        voxel_m: Edge of a voxel.
        edge: Number of voxels across.
        low_m: Height at which the lowest layer begins.
        layers: Number of layers.
    """
    volume = np.zeros((layers, edge, edge), uint8)
    for n in range(len(obstacles)):
        x = int64(obstacles[n, 0] / voxel_m + 0.5 * edge)
        y = int64(obstacles[n, 1] / voxel_m + 0.5 * edge)
        z = int64((heights[n] - low_m) / voxel_m)
        for k in range(max(z - 1, 0), min(z + 2, layers)):
            for i in range(max(y - 1, 0), min(y + 2, edge)):
                for j in range(max(x - 1, 0), min(x + 2, edge)):
                    value = FULL_OVERLAP - abs(k - z) - abs(i - y) - abs(j - x)
                    volume[k, i, j] = max(volume[k, i, j], value)
    return volume


@njit(cache=True, nogil=True)
def overlap_of(volume, points, heights, motion, voxel_m, low_m):
    """Return the sum of the volume at the points turned and moved by a planar motion.

    Args:
        volume: (Z, Y, X) of ``draw_volume``, its origin in the middle of x and y.
        points: (N, 2) or (N, 3) x and y, metres, level frame.
        heights: (N,) above the ground, metres.
        motion: (3,) dx and dy in metres, α in radians.
        voxel_m: Edge of a voxel of the volume.
        low_m: Height of its lowest layer above the ground.
    """
    dx_m, dy_m, alpha_rad = motion
    layers, edge, _ = volume.shape
    cosine, sine = np.cos(alpha_rad) / voxel_m, np.sin(alpha_rad) / voxel_m
    x0, y0 = dx_m / voxel_m + 0.5 * edge, dy_m / voxel_m + 0.5 * edge
    total = 0
    for n in range(len(points)):
        x = cosine * points[n, 0] - sine * points[n, 1] + x0
        y = sine * points[n, 0] + cosine * points[n, 1] + y0
        z = (heights[n] - low_m) / voxel_m
        if 0.0 <= x < edge and 0.0 <= y < edge and 0.0 <= z < layers:
            total += volume[int64(z), int64(y), int64(x)]
    return total


@njit(cache=True, nogil=True)
def hill_climb(volume, points, heights, motion, voxel_m, low_m, step_m, step_rad, halvings):
    """Return the (dx, dy, α) of a local maximum of the overlap near ``motion``, and its overlap.

    The best of six neighbours is taken until none is better; then the steps are halved.

    Args:
        volume: (Z, Y, X) of ``draw_volume``, its origin in the middle of x and y.
        points: (N, 2) or (N, 3) x and y of the points, metres, level frame.
        heights: (N,) heights of the points above the ground, metres.
        motion: Motion at which the search begins.
        voxel_m: Edge of a voxel of the volume.
        low_m: Height of its lowest layer above the ground.
        step_m: First step along x and y.
        step_rad: First step of α.
        halvings: Number of times that the steps are halved.
    """
    here = motion.copy()
    best = overlap_of(volume, points, heights, here, voxel_m, low_m)
    step = np.array([step_m, step_m, step_rad])
    for _ in range(halvings + 1):
        climbing = True
        while climbing:
            climbing = False
            start = here.copy()
            for k in range(6):
                there = start.copy()
                there[k // 2] += step[k // 2] if k % 2 else -step[k // 2]
                value = overlap_of(volume, points, heights, there, voxel_m, low_m)
                if value > best:
                    best = value
                    here = there
                    climbing = True
        step *= 0.5
    return here, best
