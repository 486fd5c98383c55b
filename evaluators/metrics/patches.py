"""Patches: the neighbours of points within a radius, their spread, and whether they lie in two sheets."""

import numpy as np
from numba import njit

_BITS = 20
_CENTRE = 1 << (_BITS - 1)  # cells on either side of the origin


@njit(cache=True, nogil=True)
def cell_codes(points, radius_m):  # type: ignore[no-untyped-def]
    """Return (N,) int64: the cell, as wide as the radius, that each of (N, 3) points lies in."""
    codes = np.empty(len(points), np.int64)
    for i in range(len(points)):
        codes[i] = _code(
            np.int64(np.floor(points[i, 0] / radius_m)),
            np.int64(np.floor(points[i, 1] / radius_m)),
            np.int64(np.floor(points[i, 2] / radius_m)),
        )
    return codes


@njit(cache=True, nogil=True)
def spreads(points, towards, frames, codes, queries, radius_m):  # type: ignore[no-untyped-def]
    """Return how the neighbours of some points are spread.

    Neighbours are within the radius and were seen from the same side, so that the two faces of a thin wall
    are two surfaces.

    Args:
        points: (N, 3) metres, in the order of their ``codes``.
        towards: (N, 3) from each point to where it was seen from.
        frames: (N,) int64 that each point was seen in.
        codes: (N,) ascending, of ``cell_codes``.
        queries: (Q,) int64 indices of points.
        radius_m: How far neighbours are.

    Returns:
        (Q, 3, 3) sample covariances in m², and (Q,) how many points each rests on, 0 if all are of one frame.
    """
    covariances, counts = np.zeros((len(queries), 3, 3)), np.zeros(len(queries), np.int64)
    members = np.empty(len(points), np.int64)
    for q in range(len(queries)):
        i = queries[q]
        count = _gather(points, towards, codes, i, radius_m, members)
        several = False
        mean = np.zeros(3)
        for k in range(count):
            several |= frames[members[k]] != frames[i]
            for a in range(3):
                mean[a] += (points[members[k], a] - points[i, a]) / count
        if not several:
            continue
        counts[q] = count
        for k in range(count):
            for a in range(3):
                along_a = points[members[k], a] - points[i, a] - mean[a]
                for b in range(3):
                    along_b = points[members[k], b] - points[i, b] - mean[b]
                    covariances[q, a, b] += along_a * along_b / (count - 1)
    return covariances, counts


@njit(cache=True, nogil=True)
def gaps(points, towards, codes, queries, normals, radius_m):  # type: ignore[no-untyped-def]
    """Return how far apart two sheets about each point are, in standard deviations within them.

    The neighbours half as near to the normal through the point are parted in two along it so that the parts
    differ most (Otsu 1979).

    Args:
        points: As for ``spreads``.
        towards: As for ``spreads``.
        codes: As for ``spreads``.
        queries: (Q,) int64 indices of points.
        normals: (Q, 3) unit normals there.
        radius_m: How far neighbours are.

    Returns:
        (Q,) distances between the parts' means over their spread, (Q,) the smaller part's share.
    """
    apart, shares = np.zeros(len(queries)), np.zeros(len(queries))
    members, offsets = np.empty(len(points), np.int64), np.empty(len(points))
    for q in range(len(queries)):
        i, normal = queries[q], normals[q]
        count = 0
        for k in range(_gather(points, towards, codes, i, radius_m, members)):
            square, along = 0.0, 0.0
            for a in range(3):
                difference = points[members[k], a] - points[i, a]
                square += difference * difference
                along += difference * normal[a]
            if square - along * along <= 0.25 * radius_m * radius_m:
                offsets[count] = along
                count += 1
        if count > 2:
            apart[q], shares[q] = _parted(np.sort(offsets[:count]))
    return apart, shares


@njit(cache=True, nogil=True)
def _parted(ordered):  # type: ignore[no-untyped-def]
    """Return Otsu's split of ascending numbers: distance of the means over the spread, the smaller share."""
    count = len(ordered)
    total, squares = ordered.sum(), (ordered * ordered).sum()
    best, split, below, low = -1.0, 1, 0.0, 0.0
    for k in range(1, count):
        below += ordered[k - 1]
        step = below / k - (total - below) / (count - k)
        between = k * (count - k) * step * step
        if between > best:
            best, split, low = between, k, below
    apart = (total - low) / (count - split) - low / split
    within = squares - low * low / split - (total - low) ** 2 / (count - split)
    spread = np.sqrt(max(within, 0.0) / count)
    return apart / max(spread, 1e-9), min(split, count - split) / count


@njit(cache=True, nogil=True)
def _gather(points, towards, codes, i, radius_m, members):  # type: ignore[no-untyped-def]
    """Write the indices of a point's neighbours, itself among them; return how many there are."""
    x = np.int64(np.floor(points[i, 0] / radius_m))
    y = np.int64(np.floor(points[i, 1] / radius_m))
    z = np.int64(np.floor(points[i, 2] / radius_m))
    count = 0
    for dz in range(-1, 2):
        for dy in range(-1, 2):
            # Cells along x follow each other.
            begin = np.searchsorted(codes, _code(x - 1, y + dy, z + dz))
            end = np.searchsorted(codes, _code(x + 1, y + dy, z + dz), side="right")
            for j in range(begin, end):
                square, facing = 0.0, 0.0
                for a in range(3):
                    difference = points[j, a] - points[i, a]
                    square += difference * difference
                    facing += towards[j, a] * towards[i, a]
                if square <= radius_m * radius_m and facing > 0.0:
                    members[count] = j
                    count += 1
    return count


@njit(cache=True, nogil=True)
def _code(x, y, z):  # type: ignore[no-untyped-def]
    return ((z + _CENTRE) << (2 * _BITS)) | ((y + _CENTRE) << _BITS) | (x + _CENTRE)
