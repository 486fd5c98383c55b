"""Compiled loops over a scan's points: plane scoring, height grids and thinning."""

import numpy as np
from numba import njit
from numpy import float32, float64, int32, int64


@njit(cache=True, nogil=True)
def thin(points, cell_m, reach_m):
    """Return the indices of the first point in every cubic cell, of those within reach on each axis.

    Its grid is dense: on few large cells ten times as fast as ``mapper.core.voxel_grid.thin``, whose grid is
    unbounded.
    """
    edge = int64(np.ceil(2.0 * reach_m / cell_m))
    occupied = np.zeros(edge * edge * edge, np.bool_)
    chosen = np.empty(len(points), int64)
    count = 0
    scale = 1.0 / cell_m
    for i in range(len(points)):
        x = (float64(points[i, 0]) + reach_m) * scale
        y = (float64(points[i, 1]) + reach_m) * scale
        z = (float64(points[i, 2]) + reach_m) * scale
        if min(x, y, z) < 0.0 or max(x, y, z) >= edge:
            continue
        cell = (int64(x) * edge + int64(y)) * edge + int64(z)
        if not occupied[cell]:
            occupied[cell] = True
            chosen[count] = i
            count += 1
    return chosen[:count]


@njit(cache=True, nogil=True)
def score_planes(points, triples, min_cosine, low_m, high_m, tolerance_m):
    """Return the best plane (nx, ny, nz, d) with n·p + d = 0, n up, and its score; a score < 0 is none.

    A plane's score is its number of inliers less the number of points more than
    twice as far below it: nothing lies below the ground.

    Args:
        points: (N, 3) metres.
        triples: (K, 3) indices of the points through which planes are laid.
        min_cosine: Least z of the normal.
        low_m: Least height of the origin above the plane, d.
        high_m: Largest height of the origin above the plane.
        tolerance_m: Largest distance of an inlier.
    """
    best = np.zeros(4)
    best_score = -1.0
    for k in range(len(triples)):
        a, b, c = triples[k, 0], triples[k, 1], triples[k, 2]
        ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        norm = np.sqrt(nx * nx + ny * ny + nz * nz)
        if norm < 1e-6:
            continue
        if nz < 0.0:
            norm = -norm
        nx, ny, nz = nx / norm, ny / norm, nz / norm
        d = -(nx * points[a, 0] + ny * points[a, 1] + nz * points[a, 2])
        if nz < min_cosine or d < low_m or d > high_m:
            continue
        on = below = 0
        for i in range(len(points)):
            height = nx * points[i, 0] + ny * points[i, 1] + nz * points[i, 2] + d
            if height < -2.0 * tolerance_m:
                below += 1
            elif abs(height) <= tolerance_m:
                on += 1
        score = float(on - below)
        if score > best_score:
            best_score = score
            best[0], best[1], best[2], best[3] = nx, ny, nz, d
    return best, best_score


@njit(cache=True, nogil=True)
def column_heights(points, T, cell_m, edge):
    """Return (edge, edge) count, lowest, highest and mean z of the points in each column of a centred grid.

    Empty columns hold 0, +inf, −inf and 0.

    Args:
        points: (N, 3) metres.
        T: (4, 4) from the points' frame to the grid's, whose origin is the middle of the grid.
        cell_m: Edge of a column.
        edge: Number of columns along x and along y.
    """
    count = np.zeros((edge, edge), int32)
    low = np.full((edge, edge), np.inf, float32)
    high = np.full((edge, edge), -np.inf, float32)
    total = np.zeros((edge, edge), float64)
    half, scale = 0.5 * edge, 1.0 / cell_m
    for i in range(len(points)):
        x0, y0, z0 = float64(points[i, 0]), float64(points[i, 1]), float64(points[i, 2])
        x = (T[0, 0] * x0 + T[0, 1] * y0 + T[0, 2] * z0 + T[0, 3]) * scale + half
        y = (T[1, 0] * x0 + T[1, 1] * y0 + T[1, 2] * z0 + T[1, 3]) * scale + half
        if min(x, y) < 0.0 or max(x, y) >= edge:
            continue
        z = T[2, 0] * x0 + T[2, 1] * y0 + T[2, 2] * z0 + T[2, 3]
        column, row = int64(x), int64(y)
        count[row, column] += 1
        total[row, column] += z
        low[row, column] = min(low[row, column], z)
        high[row, column] = max(high[row, column], z)
    mean = np.zeros((edge, edge), float32)
    for row in range(edge):
        for column in range(edge):
            if count[row, column]:
                mean[row, column] = total[row, column] / count[row, column]
    return count, low, high, mean


@njit(cache=True, nogil=True)
def thin_obstacles(points, T, floor, cell_m, low_m, high_m, voxel_m, voxel_edge):
    """Return (M, 4) float32 means (x, y, z, height above the floor) of the points in each voxel.

    Points lower or higher than the limits are dropped.

    Args:
        points: (N, 3).
        T: (4, 4) moves them to the level frame.
        floor: (edge, edge) height of the ground in each column of a centred grid of ``cell_m``.
        cell_m: Edge of its cells.
        low_m: Least height above the floor.
        high_m: Largest height above the floor.
        voxel_m: Edge of a voxel.
        voxel_edge: Number of voxels across; points beyond are dropped.
    """
    edge = len(floor)
    half, scale = 0.5 * edge, 1.0 / cell_m
    voxel_half, voxel_scale = 0.5 * voxel_edge, 1.0 / voxel_m
    layers = int64(np.ceil((high_m - low_m) * voxel_scale)) + 1
    slot = np.full(layers * voxel_edge * voxel_edge, -1, int32)
    sums = np.empty((len(points), 4))
    counts = np.empty(len(points), int64)
    used = 0
    for i in range(len(points)):
        x0, y0, z0 = float64(points[i, 0]), float64(points[i, 1]), float64(points[i, 2])
        x = T[0, 0] * x0 + T[0, 1] * y0 + T[0, 2] * z0 + T[0, 3]
        y = T[1, 0] * x0 + T[1, 1] * y0 + T[1, 2] * z0 + T[1, 3]
        column, row = x * scale + half, y * scale + half
        if min(column, row) < 0.0 or max(column, row) >= edge:
            continue
        z = T[2, 0] * x0 + T[2, 1] * y0 + T[2, 2] * z0 + T[2, 3]
        height = z - floor[int64(row), int64(column)]
        if not (low_m <= height <= high_m):
            continue
        i_x, i_y = x * voxel_scale + voxel_half, y * voxel_scale + voxel_half
        if min(i_x, i_y) < 0.0 or max(i_x, i_y) >= voxel_edge:
            continue
        layer = int64((height - low_m) * voxel_scale)
        voxel = (layer * voxel_edge + int64(i_y)) * voxel_edge + int64(i_x)
        s = slot[voxel]
        if s < 0:
            s = slot[voxel] = used
            used += 1
            sums[s] = 0.0
            counts[s] = 0
        sums[s, 0] += x
        sums[s, 1] += y
        sums[s, 2] += z
        sums[s, 3] += height
        counts[s] += 1
    means = np.empty((used, 4), float32)
    for s in range(used):
        for axis in range(4):
            means[s, axis] = sums[s, axis] / counts[s]
    return means
