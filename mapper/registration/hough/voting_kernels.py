"""Compiled loops of the search: the accumulator of the voting, its maxima, and the overlap near each."""

import numpy as np
from numba import njit
from numpy import int32, int64, uint8

_PHASES = 4
"""Votes are rounded to this fraction of a bin before they are binned."""
_LANES = 8
"""Rows of the accumulator are padded to whole vectors of this many votes."""
FULL_OVERLAP = 4
"""Weight of a point in an occupied voxel, less one for each axis along which it lies beside one."""


@njit(cache=True, nogil=True)
def vote_slices(target, source, cosines, sines, half_bins, bin_m, per_angle):
    """Return the highest smoothed bins of every angle's slice of the accumulator A[dx, dy, α].

    A rotated source centre votes for its offset to every target centre in reach: it adds a picture of the
    target around itself to the slice. Of that picture, summed over 3×3 bins, copies shifted by a fraction of
    a bin are drawn once, so offsets are rounded to that fraction before they are binned. One slice at a time
    is filled and searched, so the three-dimensional array is never stored.

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
                sums, drawn = accumulator[i], picture[row + i, column : column + width]
                for j in range(width):
                    sums[j] += drawn[j]
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
    """Return whether no neighbour is higher, and none that comes before is as high."""
    here, edge = smooth[row, column], len(smooth)
    for i in range(max(row - 1, 0), min(row + 2, edge)):
        for j in range(max(column - 1, 0), min(column + 2, edge)):
            other = smooth[i, j]
            if other > here or (other == here and (i < row or (i == row and j < column))):
                return False
    return True


@njit(cache=True, nogil=True)
def _summit(line, k):
    """Return the offset, −½ … ½ bins, from a maximum to the peak of the parabola about it."""
    if k == 0 or k == len(line) - 1:
        return 0.0
    left, here, right = line[k - 1], line[k], line[k + 1]
    bend = 2 * here - left - right
    return 0.5 * (right - left) / bend if bend > 0 else 0.0


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
def hill_climb(volume, points, heights, motion, voxel_m, low_m, step_rad, halvings):
    """Return the (dx, dy, α) of a local maximum of the overlap near ``motion``, and its overlap.

    The best of six neighbours is taken until none is better; then the steps are halved.

    Args:
        volume: (Z, Y, X) of ``draw_volume``, its origin in the middle of x and y.
        points: (N, 2) or (N, 3) x and y of the points, metres, level frame.
        heights: (N,) heights of the points above the ground, metres.
        motion: Motion at which the search begins.
        voxel_m: Edge of a voxel of the volume, and first step along x and y.
        low_m: Height of its lowest layer above the ground.
        step_rad: First step of α.
        halvings: Number of times that the steps are halved.
    """
    here = motion.copy()
    best = overlap_of(volume, points, heights, here, voxel_m, low_m)
    step = np.array([voxel_m, voxel_m, step_rad])
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
