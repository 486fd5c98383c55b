"""Factors of the floor: height, roll and pitch of keyframes above one plane that they see."""

from collections.abc import Mapping, Sequence

import numpy as np

from mapper.core.geometry import Array, Transform, adjoint, inverse, planar_motion, transform
from mapper.graph.drift import innovations
from mapper.graph.model import BetweenFactor, PoseGraph

_TILT_SIGMA_RAD = np.radians(0.7)
_HEIGHT_SIGMA_M = 0.03
"""Of one frame's floor: by a depth camera's calibration, and by floors that are not quite plane. Half and
twice as much change the result by a tenth."""
_OPEN_RAD, _OPEN_M = 10.0, 100.0
"""Of the motions along the floor and the turn about its normal, which it does not show."""
_OUTLIER_CHI2 = 16.27
"""99.9 % of chi² with three degrees of freedom: height, roll and pitch."""
_NEIGHBOURS = 5
_RECENT = 3
_MIN_NODES = 10
_MAX_CONTRADICTING = 0.05
"""Share of the pairs of keyframes that may see different planes by odometry."""
_ROBUST_CHI2 = 6.0
_PLANE_ITERATIONS = 8


def on_one_floor(graph: PoseGraph, T_node_floor: Mapping[int, Transform]) -> list[int]:
    """Return the nodes that see one floor; none if the odometry contradicts that there is only one.

    A node belongs to it if by odometry it sees the same plane as most of the nodes of that floor before it.
    Then pairs of nodes are compared at distances of one node, two, four and so on: stairs and ramps
    show between neighbours or, where these look over their edge, between nodes farther apart.

    Args:
        graph: Nodes with their estimates, and the odometry's factors.
        T_node_floor: (4, 4) frame in the floor plane that a node sees, z along its normal.
    """
    odometry = graph.without_loops().factors
    nodes = [node for node in graph.T_world_node if node in T_node_floor]

    def chi2(pairs: Sequence[tuple[int, int]]) -> Array:
        factors = [_same_plane(graph.T_world_node, T_node_floor, *pair) for pair in pairs]
        return innovations(odometry, factors)

    pairs = [(i, j) for k, i in enumerate(nodes) for j in nodes[k + 1 : k + 1 + _NEIGHBOURS]]
    agree = dict(zip(pairs, chi2(pairs) <= _OUTLIER_CHI2, strict=True))
    floor = max(
        (_chain(nodes[begin:], agree) for begin in range(min(_NEIGHBOURS, len(nodes)))), key=len, default=[]
    )
    if len(floor) < max(_MIN_NODES, len(nodes) // 2):
        return []
    apart = 1
    while apart < len(floor):
        pairs = [(floor[k], floor[k + apart]) for k in range(0, len(floor) - apart, max(apart // 4, 1))]
        if (chi2(pairs) > _OUTLIER_CHI2).mean() > _MAX_CONTRADICTING:
            return []
        apart *= 2
    return floor


def floor_factors(
    T_world_node: Mapping[int, Transform], T_node_floor: Mapping[int, Transform], nodes: Sequence[int]
) -> list[BetweenFactor]:
    """Return the factors that hold nodes above the plane that fits what they see best.

    Each is relative to the node in the middle, and has hardly any information about motions along the floor.
    A node whose floor is off the plane counts less (Cauchy).

    Args:
        T_world_node: Estimates of the nodes.
        T_node_floor: (4, 4) frame in the floor plane that a node sees.
        nodes: Those that see one floor; at least two.
    """
    T_world_floor = np.array([T_world_node[node] @ T_node_floor[node] for node in nodes])
    normal, height_m, weights = _common_plane(T_world_floor)
    middle = nodes[len(nodes) // 2]
    T_middle_world = inverse(T_world_node[middle])
    factors = []
    for node, T, weight in zip(nodes, T_world_floor, weights, strict=True):
        if node != middle:
            T_node_plane = T_node_floor[node]
            T_world_held = _onto_plane(T, normal, height_m) @ inverse(T_node_plane)
            covariance = _shown(1.0 / float(weight)) + _open()
            factors.append(_factor(middle, node, T_middle_world @ T_world_held, T_node_plane, covariance))
    return factors


def with_height_and_tilt(
    before: Mapping[int, Transform],
    after: Mapping[int, Transform],
    T_node_floor: Mapping[int, Transform],
    nodes: Sequence[int],
) -> dict[int, Transform]:
    """Return poses with the height and the tilt that they have after, and place and heading from before.

    The first node stays where it was.

    Where odometry is uncertain, its errors of height and tilt are correlated with those of place and heading.
    The floor measures the former; the corrections of the latter made simulated logs worse as often as better.

    Args:
        before: T_world_node without the floor.
        after: The same nodes, held above it.
        T_node_floor: (4, 4) frame in the floor plane that a node sees.
        nodes: Those that see one floor.
    """
    T_before, T_after = (_floor_frame(T, T_node_floor, nodes) for T in (before, after))
    combined = {}
    for node, T_world_node in before.items():
        there, held = inverse(T_before) @ T_world_node, inverse(T_after) @ after[node]
        turn = _planar(there @ inverse(held))[:3, :3]
        place = np.array([there[0, 3], there[1, 3], held[2, 3]])
        combined[node] = transform(turn @ held[:3, :3], place)
    first = next(iter(before))
    T_world_floor = before[first] @ inverse(combined[first])
    return {node: T_world_floor @ T_floor_node for node, T_floor_node in combined.items()}


def _floor_frame(
    T_world_node: Mapping[int, Transform], T_node_floor: Mapping[int, Transform], nodes: Sequence[int]
) -> Transform:
    """Return a (4, 4) frame in the plane that fits what nodes see best, z along its normal."""
    T_world_floor = np.array([T_world_node[node] @ T_node_floor[node] for node in nodes])
    normal, height_m, _ = _common_plane(T_world_floor)
    return _onto_plane(T_world_floor[len(nodes) // 2], normal, height_m)


def _chain(nodes: Sequence[int], agree: Mapping[tuple[int, int], np.bool_]) -> list[int]:
    """Return the nodes, from the first, of which each agrees with most of the last ones before it."""
    chain = list(nodes[:1])
    for node in nodes[1:]:
        known = [agree[earlier, node] for earlier in chain[-_RECENT:] if (earlier, node) in agree]
        if known and 2 * sum(known) >= len(known):
            chain.append(node)
    return chain


def _same_plane(
    T_world_node: Mapping[int, Transform], T_node_floor: Mapping[int, Transform], i: int, j: int
) -> BetweenFactor:
    """Return the factor by which two nodes see the same plane."""
    T_i_j = inverse(T_world_node[i]) @ T_world_node[j]
    T_floor_floor = _planar(inverse(T_node_floor[i]) @ T_i_j @ T_node_floor[j])
    to_j = adjoint(inverse(T_floor_floor))
    covariance = to_j @ _shown(1.0) @ to_j.T + _shown(1.0) + _open()
    return _factor(
        i, j, T_node_floor[i] @ T_floor_floor @ inverse(T_node_floor[j]), T_node_floor[j], covariance
    )


def _factor(i: int, j: int, T_i_j: Transform, T_j_floor: Transform, covariance: Array) -> BetweenFactor:
    """Return a factor whose (6, 6) covariance is that of the tangent of j's floor frame."""
    to_floor = adjoint(inverse(T_j_floor))
    return BetweenFactor(i, j, T_i_j, to_floor.T @ np.linalg.inv(covariance) @ to_floor)


def _shown(scale: float) -> Array:
    """Return the (6, 6) covariance of what a plane shows, in its own frame; the rest is 0."""
    tilt, height = _TILT_SIGMA_RAD**2, _HEIGHT_SIGMA_M**2
    return scale * np.diag([tilt, tilt, 0.0, 0.0, 0.0, height])


def _open() -> Array:
    """Return the (6, 6) covariance of what a plane does not show; the rest is 0."""
    return np.diag([0.0, 0.0, _OPEN_RAD**2, _OPEN_M**2, _OPEN_M**2, 0.0])


def _planar(T: Transform) -> Transform:
    """Return a motion's turn about z and its x and y."""
    return planar_motion(T[0, 3], T[1, 3], np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1]))


def _common_plane(T_world_floor: Array) -> tuple[Array, float, Array]:
    """Return normal and distance of the plane that fits (N, 4, 4) frames best, and their (N,) weights."""
    normals, points = T_world_floor[:, :3, 2], T_world_floor[:, :3, 3]
    normal = np.median(normals, axis=0)
    normal /= np.linalg.norm(normal)
    height_m = float(np.median(points @ normal))
    for _ in range(_PLANE_ITERATIONS):
        across = np.linalg.svd(normal[np.newaxis])[2][1:].T
        tilts, off_m = normals @ across, points @ normal - height_m
        chi2 = (tilts**2).sum(axis=1) / _TILT_SIGMA_RAD**2 + (off_m / _HEIGHT_SIGMA_M) ** 2
        weights = 1.0 / (1.0 + chi2 / _ROBUST_CHI2)
        rows = np.column_stack([points @ across, -np.ones(len(points))]) / _HEIGHT_SIGMA_M
        weighted = rows.T * weights
        H, g = weighted @ rows, weighted @ (off_m / _HEIGHT_SIGMA_M)
        H[:2, :2] += weights.sum() * np.eye(2) / _TILT_SIGMA_RAD**2
        g[:2] -= weights @ tilts / _TILT_SIGMA_RAD**2
        step = np.linalg.solve(H, -g)
        normal, height_m = normal + across @ step[:2], height_m + float(step[2])
        length = float(np.linalg.norm(normal))
        normal, height_m = normal / length, height_m / length
    return normal, height_m, weights


def _onto_plane(T_world_floor: Transform, normal: Array, height_m: float) -> Transform:
    """Return a frame turned and moved the shortest way so that it lies in a plane, z along its normal."""
    x = T_world_floor[:3, 0] - (T_world_floor[:3, 0] @ normal) * normal
    x /= np.linalg.norm(x)
    point = T_world_floor[:3, 3]
    point = point - (point @ normal - height_m) * normal
    return transform(np.column_stack([x, np.cross(normal, x), normal]), point)
