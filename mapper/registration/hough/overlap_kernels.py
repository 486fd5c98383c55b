"""Compiled loops that hold a motion against what both scans saw."""

import numpy as np
from numba import njit
from numpy import float32, int64, uint8

NEAR = 4
"""What a point in an occupied voxel counts; it counts one less for each axis along which it is next to it."""


@njit(cache=True, nogil=True)
def draw_volume(obstacles, heights, voxel_m, edge, low_m, layers):
    """Return (layers, edge, edge) uint8: NEAR in voxels with obstacles, less in the voxels around them.

    Args:
        obstacles: (N, 3) of which x and y are used, within edge · voxel_m / 2 of 0.
        heights: (N,) above the ground, the third coordinate.
        voxel_m: Edge of a voxel.
        edge: Voxels across.
        low_m: Height at which the lowest layer begins.
        layers: Voxels high.
    """
    volume = np.zeros((layers, edge, edge), uint8)
    for n in range(len(obstacles)):
        x = int64(obstacles[n, 0] / voxel_m + 0.5 * edge)
        y = int64(obstacles[n, 1] / voxel_m + 0.5 * edge)
        z = int64((heights[n] - low_m) / voxel_m)
        for k in range(max(z - 1, 0), min(z + 2, layers)):
            for i in range(max(y - 1, 0), min(y + 2, edge)):
                for j in range(max(x - 1, 0), min(x + 2, edge)):
                    value = NEAR - abs(k - z) - abs(i - y) - abs(j - x)
                    volume[k, i, j] = max(volume[k, i, j], value)
    return volume


@njit(cache=True, nogil=True)
def overlap_of(volume, points, heights, dx_m, dy_m, alpha_rad, voxel_m, low_m):
    """Return the sum of the volume at the points turned by α and moved by (dx, dy)."""
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
def climb(volume, points, heights, motion, voxel_m, low_m, step_m, step_rad, halvings):
    """Return the (dx, dy, α) near a first one with the most overlap, and that overlap.

    The steepest of six neighbours is taken until none is higher; then the steps are halved.
    """
    here = motion.copy()
    best = overlap_of(volume, points, heights, here[0], here[1], here[2], voxel_m, low_m)
    step = np.array([step_m, step_m, step_rad])
    for _ in range(halvings + 1):
        climbing = True
        while climbing:
            climbing = False
            start = here.copy()
            for k in range(6):
                there = start.copy()
                there[k // 2] += step[k // 2] if k % 2 else -step[k // 2]
                value = overlap_of(volume, points, heights, there[0], there[1], there[2], voxel_m, low_m)
                if value > best:
                    best = value
                    here = there
                    climbing = True
        step *= 0.5
    return here, best


@njit(cache=True, nogil=True)
def range_picture(points, origin, step_rad):
    """Return (elevations, azimuths) float32: the least range of the points in each direction from the origin.

    Directions without a point hold +inf. Rows begin straight down, columns behind.
    """
    rows, columns = int64(np.ceil(np.pi / step_rad)), int64(np.ceil(2.0 * np.pi / step_rad))
    picture = np.full((rows, columns), np.inf, float32)
    for n in range(len(points)):
        x, y, z = points[n, 0] - origin[0], points[n, 1] - origin[1], points[n, 2] - origin[2]
        across = np.sqrt(x * x + y * y)
        row = min(int64((np.arctan2(z, across) + 0.5 * np.pi) / step_rad), rows - 1)
        column = min(int64((np.arctan2(y, x) + np.pi) / step_rad), columns - 1)
        picture[row, column] = min(picture[row, column], np.sqrt(across * across + z * z))
    return picture


@njit(cache=True, nogil=True)
def look(picture, origin, points, T, step_rad, margin_m, margin_ratio, min_returns):
    """Return how many points, moved by T, lie on surfaces of a picture, and how many before all surfaces.

    Those nearer than every surface in and around their direction contradict the picture: its sensor looked
    through them. Points behind surfaces, or where the picture has few returns, say nothing.
    """
    rows, columns = picture.shape
    agree = through = 0
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3] - origin[0]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3] - origin[1]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3] - origin[2]
        across = np.sqrt(x * x + y * y)
        reach = np.sqrt(across * across + z * z)
        row = min(int64((np.arctan2(z, across) + 0.5 * np.pi) / step_rad), rows - 1)
        column = min(int64((np.arctan2(y, x) + np.pi) / step_rad), columns - 1)
        nearest, gap, returns = np.inf, np.inf, 0
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for j in range(column - 1, column + 2):
                surface = picture[i, j % columns]
                returns += surface < np.inf
                nearest = min(nearest, surface)
                gap = min(gap, abs(surface - reach))
        margin = margin_m + margin_ratio * reach
        if gap <= margin:
            agree += 1
        elif reach < nearest - margin and returns >= min_returns:
            through += 1
    return agree, through
