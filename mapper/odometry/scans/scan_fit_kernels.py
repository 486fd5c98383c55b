"""Kernels of a scan's fit: rows of its pairs, and how many pairs show a motion."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def pair_rows(
    near, partners, points, points_key, normals, near_normals, elsewhere, key_points, key_normals, R
):
    """Return the Jacobians of M pairs' distances from surfaces by the scan's tangent, and the distances.

    Args:
        near: (M,) indices of the paired points.
        partners: (N,) indices of all points' partners.
        points: (N, 3) the scan's.
        points_key: (N, 3) the same in the keyframe's frame.
        normals: (N, 3) the scan's.
        near_normals: (N, 3) the same fitted to fewer neighbours.
        elsewhere: Weight of the first in the scan's normals; the second have the rest.
        key_points: (K, 3) the keyframe's.
        key_normals: (K, 3) the keyframe's.
        R: (3, 3) rotation of the motion between both.

    Returns:
        (M, 6) rows by the keyframe's normals, (M, 6) rows by the scan's, turned towards these, and (M,)
        distances from the keyframe's surfaces, metres.
    """
    rows, own_rows, distances = np.empty((len(near), 6)), np.empty((len(near), 6)), np.empty(len(near))
    n, own = np.empty(3), np.empty(3)
    for pair in range(len(near)):
        i = near[pair]
        partner = partners[i]
        distance = 0.0
        for k in range(3):
            distance += key_normals[partner, k] * (points_key[i, k] - key_points[partner, k])
            n[k] = 0.0
            for row in range(3):
                n[k] += R[row, k] * key_normals[partner, row]
        distances[pair] = distance
        towards, near_towards = np.sign(_dot(normals[i], n)), np.sign(_dot(near_normals[i], n))
        for k in range(3):
            own[k] = (
                elsewhere * towards * normals[i, k] + (1.0 - elsewhere) * near_towards * near_normals[i, k]
            )
        _fill_row(points[i], n, rows[pair])
        _fill_row(points[i], own, own_rows[pair])
    return rows, own_rows, distances


@njit(cache=True, nogil=True)
def count_showing(motions, points, rows, own_rows, agree, facing):
    """Return (K,) numbers of pairs that show motions, or the sums of what each shows, whichever is more.

    Args:
        motions: (K, 6) tangents of the scan.
        points: (M, 3) of the pairs, the scan's.
        rows: (M, 6) by the keyframe's normals.
        own_rows: (M, 6) by the scan's.
        agree: (M,) pairs that count.
        facing: Share of a point's displacement along its normals, from which on its pair counts as one.
    """
    showing = np.empty(len(motions))
    for motion in range(len(motions)):
        x, y, z, u, v, w = motions[motion]
        count, total = 0, 0.0
        for i in range(len(points)):
            if not agree[i]:
                continue
            dx = y * points[i, 2] - z * points[i, 1] + u
            dy = z * points[i, 0] - x * points[i, 2] + v
            dz = x * points[i, 1] - y * points[i, 0] + w
            along = own_along = 0.0
            for k in range(6):
                along += motions[motion, k] * rows[i, k]
                own_along += motions[motion, k] * own_rows[i, k]
            share = along * own_along / max(dx * dx + dy * dy + dz * dz, 1e-300)
            count += share > facing
            total += share
        showing[motion] = max(float(count), total)
    return showing


@njit(cache=True, nogil=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
def _fill_row(p, n, row):
    row[0], row[1], row[2] = p[1] * n[2] - p[2] * n[1], p[2] * n[0] - p[0] * n[2], p[0] * n[1] - p[1] * n[0]
    row[3], row[4], row[5] = n[0], n[1], n[2]
