"""Compiled loops of the Hough registration: plane scoring, height grids, thinning and voting."""

import numpy as np
from numba import njit
from numpy import float32, float64, int32, int64

_PHASES = 4
"""Votes are rounded to this fraction of a bin before they are binned."""
_LANES = 8
"""Rows of the accumulator are padded to whole vectors of this many votes."""


@njit(cache=True, nogil=True)
def thin(points, cell_m, reach_m):
    """Return the indices of the first point in every cubic cell, of those within reach on each axis.

    Its grid is dense: on few large cells ten times as fast as ``mapper.core.voxel_grid.thin``, which has no bounds.
    """
    edge = int64(np.ceil(2.0 * reach_m / cell_m))
    seen = np.zeros(edge * edge * edge, np.bool_)
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
        if not seen[cell]:
            seen[cell] = True
            chosen[count] = i
            count += 1
    return chosen[:count]


@njit(cache=True, nogil=True)
def score_planes(points, triples, min_cosine, low_m, high_m, tolerance_m, below_weight):
    """Return the best plane (nx, ny, nz, d) with n·p + d = 0, n up, and its score; a score < 0 is none.

    A plane scores its inliers less ``below_weight`` times the points that lie clearly below it: nothing
    lies below the ground. ``d`` is the origin's height above the plane and stays within low … high.
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
        score = on - below_weight * below
        if score > best_score:
            best_score = score
            best[0], best[1], best[2], best[3] = nx, ny, nz, d
    return best, best_score


@njit(cache=True, nogil=True)
def column_heights(points, T, cell_m, edge):
    """Return (edge, edge) count, lowest, highest and mean z of the points in each column of a centred grid.

    The points are moved by T first; empty columns hold 0, +inf, −inf and 0.
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
        cell_m: Its cell.
        low_m: Lowest height above the floor.
        high_m: Highest.
        voxel_m: Edge of a voxel.
        voxel_edge: Voxels across; beyond, points are dropped.
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


@njit(cache=True, nogil=True)
def vote_slices(target, source, cosines, sines, half_bins, bin_m, per_angle):
    """Return the highest smoothed bins of every angle's slice of the accumulator A[dx, dy, α].

    A source centre, once rotated, votes for its offset to every target centre in reach: it adds the target's
    picture around itself to the slice. Of that picture, summed over 3×3 bins, copies shifted by a fraction
    of a bin are drawn once, so offsets are rounded to that fraction before they are binned. One slice at a
    time is filled and searched, so the three-dimensional array is never there.

    Args:
        target: (N, 2) centres, N ≥ 1.
        source: (M, 2) centres.
        cosines: (A,) of the angles.
        sines: (A,).
        half_bins: The accumulator has 2·half_bins + 1 bins on a side, one of them centred on zero.
        bin_m: Edge of a bin.
        per_angle: Maxima kept per slice.

    Returns:
        (A, per_angle) votes, 0 where there is no further maximum, and (A, per_angle, 2) offsets in bins.
    """
    edge = 2 * half_bins + 1
    width = -(-edge // _LANES) * _LANES
    low_x, low_y, pictures = _pictures(target, half_bins, width, bin_m)
    rows, columns = pictures.shape[1] - edge, pictures.shape[2] - width
    votes = np.zeros((len(cosines), per_angle), int32)
    offsets = np.zeros((len(cosines), per_angle, 2))
    accumulator = np.empty((edge, width), int32)
    for a in range(len(cosines)):
        accumulator[:] = 0
        for s in range(len(source)):
            x = (cosines[a] * source[s, 0] - sines[a] * source[s, 1]) / bin_m - low_x
            y = (sines[a] * source[s, 0] + cosines[a] * source[s, 1]) / bin_m - low_y
            if not (0.0 <= x < columns and 0.0 <= y < rows):
                continue
            fine_x, fine_y = int64(x * _PHASES), int64(y * _PHASES)
            picture = pictures[(fine_y % _PHASES) * _PHASES + fine_x % _PHASES]
            row, column = fine_y // _PHASES, fine_x // _PHASES
            for i in range(edge):
                sums, seen = accumulator[i], picture[row + i, column : column + width]
                for j in range(width):
                    sums[j] += seen[j]
        _maxima(accumulator[:, :edge], votes[a], offsets[a], half_bins)
    return votes, offsets


@njit(cache=True, nogil=True)
def _pictures(target, half_bins, width, bin_m):
    """Return the corner (x, y) in bins, and the target drawn once for each fraction of a bin, in 3×3 sums.

    Row r, column c of a picture holds the votes for the first bin of a source centre in cell (r, c).
    """
    low_x = target[:, 0].min() / bin_m - half_bins - 2.0
    low_y = target[:, 1].min() / bin_m - half_bins - 2.0
    # Sources up to half_bins beyond the last target vote too, and read a whole accumulator from there on.
    rows = int64(target[:, 1].max() / bin_m - low_y) + 3 * half_bins + 4
    columns = int64(target[:, 0].max() / bin_m - low_x) + 2 * half_bins + width + 4
    pictures = np.zeros((_PHASES * _PHASES, rows, columns), int32)
    for phase_y in range(_PHASES):
        for phase_x in range(_PHASES):
            picture = pictures[phase_y * _PHASES + phase_x]
            # Bin number half_bins is centred on zero; a source stands in the middle of its fraction.
            shift_x = half_bins + 0.5 - (phase_x + 0.5) / _PHASES - low_x
            shift_y = half_bins + 0.5 - (phase_y + 0.5) / _PHASES - low_y
            for t in range(len(target)):
                column = int64(target[t, 0] / bin_m + shift_x)
                row = int64(target[t, 1] / bin_m + shift_y)
                for i in range(row - 1, row + 2):
                    for j in range(column - 1, column + 2):
                        picture[i, j] += 1
    return low_x, low_y, pictures


@njit(cache=True, nogil=True)
def _maxima(smooth, votes, offsets, half_bins):
    """Write the highest local maxima of a slice, the highest first; of equals the first in row order."""
    edge = len(smooth)
    for row in range(edge):
        for column in range(edge):
            here = smooth[row, column]
            if here <= votes[-1] or not _is_maximum(smooth, row, column):
                continue
            k = len(votes) - 1
            while k > 0 and here > votes[k - 1]:
                votes[k] = votes[k - 1]
                offsets[k] = offsets[k - 1]
                k -= 1
            votes[k] = here
            offsets[k, 0] = column - half_bins + _summit(smooth[row], column)
            offsets[k, 1] = row - half_bins + _summit(smooth[:, column], row)


@njit(cache=True, nogil=True)
def _is_maximum(smooth, row, column):
    """Tell whether no neighbour is higher, and none that comes before is as high."""
    here, edge = smooth[row, column], len(smooth)
    for i in range(max(row - 1, 0), min(row + 2, edge)):
        for j in range(max(column - 1, 0), min(column + 2, edge)):
            other = smooth[i, j]
            if other > here or (other == here and (i < row or (i == row and j < column))):
                return False
    return True


@njit(cache=True, nogil=True)
def _summit(line, k):
    """Return where, −½ … ½ bins from a maximum, the parabola through it and its neighbours peaks."""
    if k == 0 or k == len(line) - 1:
        return 0.0
    left, here, right = line[k - 1], line[k], line[k + 1]
    bend = 2 * here - left - right
    return 0.5 * (right - left) / bend if bend > 0 else 0.0


@njit(cache=True, nogil=True)
def distinct(offsets, turns, most, distance, angle):
    """Return the indices, at most ``most``, of those that no kept one before them is near in both measures.

    Args:
        offsets: (N, 2), the best first.
        turns: (N,) radians.
        most: Largest number kept.
        distance: Offsets farther apart are distinct.
        angle: Turns farther apart, in radians, are distinct.
    """
    kept = np.empty(most, int64)
    count = 0
    for i in range(len(offsets)):
        near = False
        for k in kept[:count]:
            gap = abs(turns[i] - turns[k]) % (2.0 * np.pi)
            gap = min(gap, 2.0 * np.pi - gap)
            if (
                gap <= angle
                and np.hypot(offsets[i, 0] - offsets[k, 0], offsets[i, 1] - offsets[k, 1]) <= distance
            ):
                near = True
                break
        if not near:
            kept[count] = i
            count += 1
            if count == most:
                break
    return kept[:count]
