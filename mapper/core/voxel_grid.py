"""Voxel grid downsampling: the first point in every voxel, or the mean of its points."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Points
from mapper.core.voxel_index import cell_key, claim_row, voxel_index

DIAGONAL = math.sqrt(3.0)
"""Largest distance of the centres of voxels that share a corner, in edges."""


def thin(points: Points32, voxel_m: float) -> NDArray[np.intp]:
    """Return the indices of the first point in every voxel, ascending.

    Unlike a mean, a point that is kept has its own time and range.

    Args:
        points: (N, 3) finite, metres.
        voxel_m: Edge of a voxel.
    """
    return voxel_numbers(points, voxel_m)[1]


def thin_in_range(
    points: Points32, origin: Points32, min_range_m: float, max_range_m: float, voxel_m: float
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Return the (M,) indices of the first point in range in every voxel, ascending, and their ranges.

    Args:
        points: (N, 3) float32, finite, metres.
        origin: (3,) float32, metres: where ranges begin.
        min_range_m: Nearer points are left out.
        max_range_m: Farther ones, too.
        voxel_m: Edge of a voxel; 0 keeps all points in range.
    """
    index = voxel_index(len(points))
    limits = np.float32(min_range_m), np.float32(max_range_m)
    found: tuple[NDArray[np.intp], NDArray[np.float32]] = _in_range(points, origin, *limits, voxel_m, index)
    return found


def voxel_means(points: Points | Points32, voxel_m: float) -> Points:
    """Return (M, 3) float64 means of the points in every voxel, in the order of each voxel's first point.

    Args:
        points: (N, 3) finite, metres.
        voxel_m: Edge of a voxel.
    """
    voxel_of, firsts = voxel_numbers(points, voxel_m)
    means: Points = _means(points, voxel_of, len(firsts))
    return means


def voxel_numbers(points: Points | Points32, voxel_m: float) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Return (N,) each point's voxel, numbered in order of first points, and (M,) those first points."""
    voxel_of, firsts = _voxels(points, 1.0 / voxel_m, voxel_index(len(points)))
    return voxel_of, firsts


@njit(cache=True, nogil=True)
def _voxels(points, voxels_per_m, index):
    voxel_of, firsts = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    count = 0
    for i in range(len(points)):
        key = cell_key(points[i, 0] * voxels_per_m, points[i, 1] * voxels_per_m, points[i, 2] * voxels_per_m)
        voxel = claim_row(index, key, count)
        if voxel == count:
            firsts[count] = i
            count += 1
        voxel_of[i] = voxel
    return voxel_of, firsts[:count].copy()


@njit(cache=True, nogil=True)
def _in_range(points, origin, min_range, max_range, voxel, index):
    kept, ranges = np.empty(len(points), np.int64), np.empty(len(points), np.float32)
    voxels_per_m, count = 1.0 / voxel if voxel > 0.0 else 0.0, 0
    for i in range(len(points)):
        x, y, z = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        range_m = np.sqrt(x * x + y * y + z * z)
        if not min_range <= range_m <= max_range:
            continue
        if voxel > 0.0:
            key = cell_key(
                points[i, 0] * voxels_per_m, points[i, 1] * voxels_per_m, points[i, 2] * voxels_per_m
            )
            if claim_row(index, key, count) < count:
                continue
        kept[count], ranges[count] = i, range_m
        count += 1
    return kept[:count].copy(), ranges[:count].copy()


@njit(cache=True, nogil=True)
def _means(points, voxel_of, count):
    sums, counts = np.zeros((count, 3)), np.zeros(count)
    for index in range(len(points)):
        voxel = voxel_of[index]
        for k in range(3):
            sums[voxel, k] += points[index, k]
        counts[voxel] += 1.0
    for voxel in range(count):
        for k in range(3):
            sums[voxel, k] /= counts[voxel]
    return sums
