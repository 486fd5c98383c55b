"""Line-of-sight tests in a distance field, and path shortening by them (string pulling)."""

from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array, path_length
from mapper.navigation.distance import DistanceField, Distances, interpolated

_GAIN = 1e-4  # of the length: a round that shortens by less is the last
_MOST_ROUNDS = 30
_MOST_POINTS = 4000
_STEEPEST = 3.0**0.5  # slope of a trilinear mix of distances that differ by at most 1 between neighbours
_LEAST_STEP = 0.2  # cells, where a line's clearance is just the radius


def shortened(field: DistanceField, path: Array, *, radius_m: float) -> Array:
    """Return a shortened path: the same ends, with the clearance kept, never longer.

    Each round puts points every cell along the path and connects each to the farthest point in sight, from
    either end in turn, until a round shortens the path by less than 10⁻⁴.

    Args:
        field: Distances to obstacles.
        path: (N, 3) z, y, x in cells; cell [0, 0, 0] spans 0 … 1. Each segment has the clearance.
        radius_m: The clearance.

    Returns:
        (M, 3) corners.
    """
    best = _corners(field, path, radius_m)
    for _ in range(_MOST_ROUNDS):
        length = path_length(best)
        forth = _corners(field, _sampled(best), radius_m)
        back = _corners(field, _sampled(forth)[::-1], radius_m)[::-1]
        best = min(best, forth, back, key=path_length)
        if path_length(best) > (1.0 - _GAIN) * length:
            break
    return best


def in_sight(field: DistanceField, begin: Array, end: Array, *, radius_m: float) -> bool:
    """Return whether a line has a clearance of ``radius_m`` all along.

    Args:
        field: Distances to obstacles.
        begin: (3,) z, y, x in cells.
        end: (3,) z, y, x in cells.
        radius_m: The clearance.
    """
    return bool(_visible(field.distances_m, field.resolution_m, radius_m, begin, end))


def _sampled(path: Array) -> Array:
    """Return points about a cell apart along a path, its corners included."""
    spacing = max(1.0, path_length(path) / _MOST_POINTS)
    parts = []
    for begin, end in pairwise(path):
        count = max(1, int(np.ceil(np.linalg.norm(end - begin) / spacing)))
        parts.append(begin + (end - begin) * (np.arange(count) / count)[:, np.newaxis])
    return np.vstack([*parts, path[-1:]])


def _corners(field: DistanceField, path: Array, radius_m: float) -> Array:
    kept = _anchors(field.distances_m, field.resolution_m, radius_m, np.ascontiguousarray(path))
    corners: Array = path[kept]
    return corners


@njit(cache=True, nogil=True)
def _anchors(distances: Distances, resolution_m: float, radius_m: float, path: Array) -> NDArray[np.int64]:
    """Return the indices of a path's points that are joined by straight lines with the clearance."""
    kept = np.empty(len(path), np.int64)
    kept[0], count, anchor = 0, 1, 0
    while anchor < len(path) - 1:
        ahead, stride, grows = anchor + 1, 1, True
        while stride > 0:  # doubled while points are in sight, then halved: testing each is quadratic
            further = min(ahead + stride, len(path) - 1)
            if further > ahead and _visible(distances, resolution_m, radius_m, path[anchor], path[further]):
                ahead = further
            else:
                grows = False
            stride = stride * 2 if grows else stride // 2
        kept[count] = anchor = ahead
        count += 1
    return kept[:count]


@njit(cache=True, nogil=True)
def _visible(distances: Distances, resolution_m: float, radius_m: float, begin: Array, end: Array) -> bool:
    """Return whether a line has the clearance, by steps as long as the distance allows (Hart 1996)."""
    dz, dy, dx = end[0] - begin[0], end[1] - begin[1], end[2] - begin[2]
    length = np.sqrt(dz * dz + dy * dy + dx * dx)
    done = 0.0
    while True:
        share = min(done / length, 1.0) if length > 0.0 else 1.0
        z, y, x = begin[0] + share * dz, begin[1] + share * dy, begin[2] + share * dx
        slack_m = interpolated(distances, z, y, x)[0] - radius_m
        if slack_m < 0.0:
            return False
        if share == 1.0:
            return True
        done += max(slack_m / resolution_m / _STEEPEST, _LEAST_STEP)
