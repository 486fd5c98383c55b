"""Plane adjustment: bundle adjustment of LiDAR poses, by which the surfaces that scans share become thin.

The cost is that of Liu, Liu & Zhang (2023), the least eigenvalue of each surface's points, as point clusters:
a cluster's sum and products of its points take the place of the points. In place of a sum of eigenvalues λ,
it is ½ N ln(λ + floor²), the likelihood of N points whose noise is not known: rough surfaces count less
(Droeschel, Stückler & Behnke 2014 call it the map's entropy). The pose graph's own factors are added, so that
motions that no surface shows stay as they were. Planes are eliminated by the Schur complement (Triggs et al.
2000, §6.1), without forming it: its product with a vector takes one pass over the clusters, and steps are
found by conjugate gradients, which a sparse factorisation of the graph with each node's own surfaces
preconditions. Time and memory grow with the number of clusters alone.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform, exp, mean_rotation, transform
from mapper.core.voxel_grid import voxel_numbers
from mapper.graph.components import components
from mapper.graph.gtsam_factors import between, gauge, values_of
from mapper.graph.least_squares import problem_of
from mapper.graph.model import PoseGraph
from mapper.graph.plane_kernels import (
    Linearised,
    Surfaces,
    cluster_moments,
    linearise,
    points_in_world,
    times_eliminated,
)
from mapper.runtime.progress import Report

EDGES = (5.0, 2.5, 1.25)
"""Edges of the cells, from coarse to fine, in voxels of the odometry."""
_FLATNESS = 0.3
"""Largest ratio of a surface's least variance to its second: rough ones too, since flat ground alone, whose
rings move along with the sensor, pulls poses together."""
_BREADTH = 0.1
"""Least ratio of its second variance to its largest: below, it is a line, such as one ring."""
_FEWEST_POINTS = 15
_ENOUGH = 10.0
"""Points of a cluster beyond which more hardly count, as they share its errors; 3 and 30 are as good."""
_FLOOR = 0.075
"""Thickness in voxels below which surfaces do not count more: 3 cm outdoors, as the errors of calibration."""
_ROUNDS, _STEPS = 3, 5
"""Times that surfaces are found, and steps with each."""
_LEAST_GAIN = 1e-4
"""Share of the cost's decrease so far, below which a step is the last."""
_DAMPINGS = (0.0, 1e-3, 1e-1)
"""Shares of the diagonal (Marquardt 1963), tried in turn until the cost falls."""
_PLACE = 25.0
"""Edge of a place in voxels, 10 m outdoors."""
_LEAST = 0.0025
"""Thickness in voxels that is added where surfaces judge, 1 mm outdoors: that of exact points is 0."""
_RESIDUAL, _MOST_PRODUCTS = 1e-3, 200
"""Share of the gradient's norm that a step may leave: the next step has it; 10 to 25 products are usual."""


@dataclass(frozen=True, slots=True, eq=False)
class NodeClouds:
    """Points of scans, in the nodes that they move with.

    Attributes:
        points_node: (N, 3) metres.
        nodes: (N,) each point's node, as its row in ``PoseGraph.poses``.
    """

    points_node: Points
    nodes: NDArray[np.int64]

    def __getitem__(self, which: Any) -> "NodeClouds":
        return NodeClouds(self.points_node[which], self.nodes[which])


def adjust_planes(
    graph: PoseGraph, clouds: NodeClouds, *, voxel_m: float, report: Report = lambda _done, _total: None
) -> PoseGraph:
    """Return the graph at the poses at which the clouds' common surfaces are thinnest.

    Without measured positions or fixed nodes, surfaces and factors leave open where all of it is: it stays in
    the mean where it was.

    Args:
        graph: Solved.
        clouds: Points of its nodes.
        voxel_m: Voxels to which the clouds were thinned.
        report: Receives the rounds done, and how many there are.
    """
    problem = _Problem(graph, _FLOOR * voxel_m)
    poses = graph.poses
    for done in range(1, _ROUNDS + 1):
        poses = problem.descend(poses, find_surfaces(clouds, poses, voxel_m=voxel_m))
        report(done, _ROUNDS)
    if not graph.fixes and not graph.fixed:
        poses = _mean_motion(poses, graph.poses) @ poses
    return graph.with_poses(dict(zip(graph.T_world_node, poses, strict=True)))


@dataclass(frozen=True, slots=True, eq=False)
class Thinning:
    """How much thinner surfaces are at other poses.

    Attributes:
        surfaces: Number of them.
        thinner_sigmas: Mean decrease of the thickness's logarithm, in its standard errors.
        before_m: Geometric mean of the standard deviations of points across their surface.
        after_m: The same at the other poses.
    """

    surfaces: int
    thinner_sigmas: float
    before_m: float
    after_m: float


def compare_thickness(clouds: NodeClouds, before: Array, after: Array, *, voxel_m: float) -> Thinning | None:
    """Return how thick the surfaces of some points are at two times (K, 4, 4) T_world_node.

    None if they are in one place at most. Surfaces weigh as the root of their points: their noise would have
    them weigh as the points, and what else differs from surface to surface, alike. The standard error is that
    of clusters (Liang & Zeger 1986), since surfaces of one place err alike.
    """
    surfaces = find_surfaces(clouds, before, voxel_m=voxel_m)
    least_m = _LEAST * voxel_m
    variances = [linearise(surfaces, poses, least_m, _ENOUGH).variances_m2 for poses in (before, after)]
    places = np.floor(surfaces.origins_world / (_PLACE * voxel_m))
    place_of = np.unique(places, axis=0, return_inverse=True)[1].ravel()
    count = len(place_of)
    if count == 0 or place_of.max() == 0:
        return None
    shares = np.sqrt(np.add.reduceat(surfaces.moments[:, 3, 3], surfaces.starts[:-1]))
    shares /= shares.sum()
    logs = 0.5 * np.log(np.array(variances) + least_m**2)
    before_log, after_log = (logs * shares).sum(axis=1).tolist()
    gain = before_log - after_log
    sums = np.bincount(place_of, shares * (logs[0] - logs[1] - gain))
    error = float(np.sqrt((sums**2).sum()))
    sigmas = gain / error if error > 0.0 else 0.0
    return Thinning(count, sigmas, float(np.exp(before_log)), float(np.exp(after_log)))


def find_surfaces(clouds: NodeClouds, poses: Array, *, voxel_m: float) -> Surfaces:
    """Return the surfaces of which two nodes or more have points, in cells as large as they are flat in.

    The two faces of a wall are two surfaces.

    Args:
        clouds: Points in their nodes.
        poses: (K, 4, 4) T_world_node.
        voxel_m: Unit of the cells' edges.
    """
    points = points_in_world(clouds.points_node, clouds.nodes, poses)
    surface_of = np.full(len(points), -1)
    left = np.arange(len(points))
    origins, normals = [np.empty((0, 3))], [np.empty((0, 3))]
    count = 0
    for edge in EDGES:
        cell_of, firsts = voxel_numbers(points[left], edge * voxel_m)
        centres = (np.floor(points[left[firsts]] / (edge * voxel_m)) + 0.5) * (edge * voxel_m)
        moments = cluster_moments(points[left] - centres[cell_of], cell_of, len(firsts))
        n = moments[:, 3, 3]
        mean = moments[:, :3, 3] / n[:, None]
        covariance = moments[:, :3, :3] / n[:, None, None] - mean[:, :, None] * mean[:, None, :]
        values, vectors = np.linalg.eigh(covariance)
        is_surface = n >= _FEWEST_POINTS
        is_surface &= (values[:, 0] < _FLATNESS * values[:, 1]) & (values[:, 1] > _BREADTH * values[:, 2])
        numbers = np.where(is_surface, count + np.cumsum(is_surface) - 1, -1)
        surface_of[left] = numbers[cell_of]
        left = left[~is_surface[cell_of]]
        origins.append((centres + mean)[is_surface])
        normals.append(vectors[is_surface, :, 0])
        count += int(is_surface.sum())
    return _clusters(clouds, poses, surface_of, np.concatenate(origins), np.concatenate(normals))


def _clusters(
    clouds: NodeClouds, poses: Array, surface_of: NDArray[np.int64], origins: Points, normals: Array
) -> Surfaces:
    """Return the clusters of the points' surfaces, each face by itself, without those that one node sees."""
    on = np.flatnonzero(surface_of >= 0)
    surface, node = surface_of[on], clouds.nodes[on]
    is_behind = np.einsum("ni,ni->n", poses[node][:, :3, 3] - origins[surface], normals[surface]) < 0.0
    keys, cluster_of = np.unique((2 * surface + is_behind) * len(poses) + node, return_inverse=True)
    faces, sizes = np.unique(keys // len(poses), return_counts=True)
    is_shared = np.repeat(sizes >= 2, sizes)
    numbers = np.where(is_shared, np.cumsum(is_shared) - 1, -1)
    moments = cluster_moments(clouds.points_node[on], numbers[cluster_of], int(is_shared.sum()))
    starts = np.concatenate([[0], np.cumsum(sizes[sizes >= 2])])
    return Surfaces(starts, (keys % len(poses))[is_shared], moments, origins[faces[sizes >= 2] // 2])


class _Problem:
    """The sum of the surfaces' cost and the graph's, of which ``descend`` finds a minimum."""

    def __init__(self, graph: PoseGraph, floor_m: float) -> None:
        self._nodes = list(graph.T_world_node)
        self._floor_m = floor_m
        held = [term for part in components(graph) for term in gauge(graph, set(part), part[0])]
        self._terms = problem_of([*map(between, graph.factors), *held])

    def descend(self, poses: Array, surfaces: Surfaces) -> Array:
        """Return the poses after some steps, each of which lowers the cost."""
        linearised = linearise(surfaces, poses, self._floor_m, _ENOUGH)
        first = cost = linearised.cost + self._terms.error(self._values(poses))
        for _ in range(_STEPS):
            before = cost
            for damping in _DAMPINGS:
                steps = self._steps(poses, surfaces, linearised, damping)
                moved = np.array([T @ exp(step[:3], step[3:]) for T, step in zip(poses, steps, strict=True)])
                after = linearise(surfaces, moved, self._floor_m, _ENOUGH)
                cost = after.cost + self._terms.error(self._values(moved))
                if cost < before:
                    break
            else:
                return poses
            poses, linearised = moved, after
            if before - cost < _LEAST_GAIN * (first - cost):
                return poses
        return poses

    def _values(self, poses: Array) -> Any:
        return values_of(dict(zip(self._nodes, poses, strict=True)), self._nodes)

    def _steps(self, poses: Array, surfaces: Surfaces, linearised: Linearised, damping: float) -> Array:
        """Return (K, 6) the damped Gauss–Newton step of every node."""
        from scipy.sparse import diags_array
        from scipy.sparse.linalg import splu

        hessian, gradient = self._linearised_graph(poses)
        held = hessian + _block_diagonal(linearised.own)
        held = (held + diags_array(damping * held.diagonal())).tocsc()
        factors = splu(held)

        def product(x: Array) -> Array:
            reduced: Array = held @ x - times_eliminated(surfaces, linearised, x.reshape(-1, 6)).ravel()
            return reduced

        steps = _conjugate_gradients(product, factors.solve, -gradient - linearised.gradient.ravel())
        return steps.reshape(-1, 6)

    def _linearised_graph(self, poses: Array) -> tuple[Any, Array]:
        """Return the graph's sparse (6K, 6K) Hessian and (6K,) gradient."""
        from scipy.sparse import coo_array

        linear = self._terms.linearize(self._values(poses))
        place = {node: 6 * index for index, node in enumerate(self._nodes)}
        rows, columns, elements, errors = [], [], [], []
        first = 0
        for k in range(linear.size()):
            jacobian, error = linear.at(k).jacobian()
            at = np.concatenate([place[key] + np.arange(6) for key in [*linear.at(k).keys()]])
            i, j = np.indices(jacobian.shape)
            rows.append((first + i).ravel())
            columns.append(at[j].ravel())
            elements.append(jacobian.ravel())
            errors.append(error)
            first += len(error)
        where = np.concatenate(rows), np.concatenate(columns)
        A = coo_array((np.concatenate(elements), where), shape=(first, 6 * len(self._nodes))).tocsc()
        return A.T @ A, -np.asarray(A.T @ np.concatenate(errors))


def _mean_motion(poses: Array, onto: Array) -> Transform:
    """Return the (4, 4) motion that takes (K, 4, 4) poses onto others in the mean."""
    R = mean_rotation(onto[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.ones(len(poses)))
    return transform(R, onto[:, :3, 3].mean(axis=0) - R @ poses[:, :3, 3].mean(axis=0))


def _block_diagonal(blocks: Array) -> Any:
    from scipy.sparse import bsr_array

    count = len(blocks)
    indices = np.arange(count), np.arange(count + 1)
    return bsr_array((blocks, *indices), shape=(6 * count, 6 * count))


def _conjugate_gradients(
    product: Callable[[Array], Array], precondition: Callable[[Array], Array], b: Array
) -> Array:
    """Return x with product(x) = b (Hestenes & Stiefel 1952); sums are NumPy's own, alike on any machine."""
    x, r = np.zeros_like(b), b.copy()
    z = precondition(r)
    p, rz = z, float((r * z).sum())
    enough = _RESIDUAL**2 * rz
    for _ in range(_MOST_PRODUCTS):
        if rz <= enough:
            break
        Ap = product(p)
        step = rz / float((p * Ap).sum())
        x, r = x + step * p, r - step * Ap
        z = precondition(r)
        before, rz = rz, float((r * z).sum())
        p = z + rz / before * p
    return x
