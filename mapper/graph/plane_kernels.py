"""Compiled sums over point clusters: surfaces fitted to them, and how their thickness changes."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array


class Surfaces(NamedTuple):
    """Point clusters, surface by surface: the points of one surface that one node has.

    Attributes:
        starts: (S + 1,) first cluster of each surface, and the number of all clusters, C.
        nodes: (C,) row of each cluster's node.
        moments: (C, 4, 4) sums of p pᵀ over its points (x, y, z, 1), metres, in its node.
        origins_world: (S, 3) near each surface, metres: its sums are taken there, to keep their digits.
    """

    starts: NDArray[np.int64]
    nodes: NDArray[np.int64]
    moments: Array
    origins_world: Array


class Linearised(NamedTuple):
    """The cost of all surfaces to second order in the nodes' tangents (rotation, translation) and the planes.

    Attributes:
        cost: Σ ½ N ln(λ + floor²) over surfaces: N their points, λ the least eigenvalue of their covariance.
        variances_m2: (S,) λ.
        gradient: (K, 6) of the cost.
        own: (K, 6, 6) second derivatives with respect to one node, the planes held.
        across: (C, 6, 3) those with respect to a cluster's node and its plane: two tilts, an offset.
        planes: (S, 3, 3) inverse of those with respect to a plane.
    """

    cost: float
    variances_m2: Array
    gradient: Array
    own: Array
    across: Array
    planes: Array


@njit(cache=True, nogil=True)
def points_in_world(points_node, nodes, poses):
    """Return (N, 3) points, each of one node, in the world."""
    points = np.empty_like(points_node)
    for index in range(len(points)):
        T = poses[nodes[index]]
        x, y, z = points_node[index]
        for i in range(3):
            points[index, i] = T[i, 0] * x + T[i, 1] * y + T[i, 2] * z + T[i, 3]
    return points


@njit(cache=True, nogil=True)
def cluster_moments(points, cluster_of, count):
    """Return (count, 4, 4) sums of p pᵀ over (N, 3) points as (x, y, z, 1); −1 is no cluster."""
    moments = np.zeros((count, 4, 4))
    p = np.ones(4)
    for index in range(len(points)):
        cluster = cluster_of[index]
        if cluster >= 0:
            p[:3] = points[index]
            for i in range(4):
                for j in range(4):
                    moments[cluster, i, j] += p[i] * p[j]
    return moments


@njit(cache=True, nogil=True)
def linearise(surfaces, poses, floor_m, enough):
    """Return the cost, its gradient and its Gauss–Newton Hessian; see ``Linearised``.

    Args:
        surfaces: Point clusters.
        poses: (K, 4, 4) T_world_node.
        floor_m: Thickness that no surface falls below.
        enough: Points of one cluster beyond which more hardly count: n count as n / (1 + n / enough).
    """
    starts, nodes, moments, origins = surfaces
    count, clusters = len(origins), len(nodes)
    variances = np.empty(count)
    gradient, own = np.zeros((len(poses), 6)), np.zeros((len(poses), 6, 6))
    across, planes = np.empty((clusters, 6, 3)), np.empty((count, 3, 3))
    T, TM, total = np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4))
    rows, rows_M = np.zeros((4, 6)), np.empty((6, 4))
    plane, plane_node = np.empty((4, 1)), np.empty((4, 1))
    motions, motions_node = np.zeros((4, 3)), np.empty((4, 3))
    motions[3, 2] = 1.0
    cost = 0.0
    for s in range(count):
        total[:] = 0.0
        for k in range(starts[s], starts[s + 1]):
            _pose_about(poses[nodes[k]], origins[s], T)
            TM[:] = 0.0
            _add_product(T, moments[k], 1.0 / (1.0 + moments[k, 3, 3] / enough), TM)
            _add_product(TM, T.T, 1.0, total)
        n = total[3, 3]
        mean = total[:3, 3] / n
        values, vectors = np.linalg.eigh(total[:3, :3] / n - np.outer(mean, mean))
        variances[s] = max(values[0], 0.0)
        cost += 0.5 * n * np.log(variances[s] + floor_m * floor_m)
        weight = 1.0 / (variances[s] + floor_m * floor_m)
        for i in range(3):
            plane[i, 0], motions[i, 0], motions[i, 1] = vectors[i]
        plane[3, 0] = motions[3, 0] = motions[3, 1] = 0.0
        for i in range(3):
            plane[3, 0] -= vectors[i, 0] * mean[i]
            motions[3, 0] -= vectors[i, 1] * mean[i]
            motions[3, 1] -= vectors[i, 2] * mean[i]
        planes[s] = np.linalg.inv(weight * (motions.T @ total @ motions))
        for k in range(starts[s], starts[s + 1]):
            node = nodes[k]
            _pose_about(poses[node], origins[s], T)
            plane_node[:], motions_node[:], rows_M[:] = 0.0, 0.0, 0.0
            _add_product(T.T, plane, 1.0, plane_node)
            _add_product(T.T, motions, 1.0, motions_node)
            x, y, z = plane_node[0, 0], plane_node[1, 0], plane_node[2, 0]
            # The distance of a point p changes by (p × n, n) · tangent: (p, 1) times these rows.
            rows[0, 1], rows[0, 2], rows[1, 2] = -z, y, -x
            rows[1, 0], rows[2, 0], rows[2, 1] = z, -y, x
            rows[3, 3], rows[3, 4], rows[3, 5] = x, y, z
            _add_product(rows.T, moments[k], weight / (1.0 + moments[k, 3, 3] / enough), rows_M)
            _add_product(rows_M, plane_node, 1.0, gradient[node].reshape(6, 1))
            _add_product(rows_M, rows, 1.0, own[node])
            across[k] = 0.0
            _add_product(rows_M, motions_node, 1.0, across[k])
    return Linearised(cost, variances, gradient, own, across, planes)


@njit(cache=True, nogil=True)
def _add_product(A, B, factor, total):
    """Add factor · A · B to a matrix."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            element = 0.0
            for k in range(A.shape[1]):
                element += A[i, k] * B[k, j]
            total[i, j] += factor * element


@njit(cache=True, nogil=True)
def _pose_about(T_world_node, origin_world, T):
    """Write the pose relative to an origin to T."""
    T[:] = T_world_node
    for i in range(3):
        T[i, 3] -= origin_world[i]


@njit(cache=True, nogil=True)
def times_eliminated(surfaces, linearised, x):
    """Return Σ across · planes · acrossᵀ times (K, 6): what free planes take away from the Hessian."""
    starts, nodes = surfaces.starts, surfaces.nodes
    across, planes = linearised.across, linearised.planes
    product = np.zeros_like(x)
    y, z = np.empty(3), np.empty(3)
    for s in range(len(planes)):
        y[:] = 0.0
        for k in range(starts[s], starts[s + 1]):
            for i in range(6):
                for j in range(3):
                    y[j] += across[k, i, j] * x[nodes[k], i]
        for i in range(3):
            z[i] = planes[s, i, 0] * y[0] + planes[s, i, 1] * y[1] + planes[s, i, 2] * y[2]
        for k in range(starts[s], starts[s + 1]):
            for i in range(6):
                for j in range(3):
                    product[nodes[k], i] += across[k, i, j] * z[j]
    return product
