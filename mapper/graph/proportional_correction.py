"""Proportional loop correction: a loop's error distributed along the path (Somlyai, PhD thesis, §4.3)."""

from collections.abc import Mapping

import numpy as np

from mapper.core.errors import GraphError
from mapper.core.geometry import Array, Transform, inverse, nearest_rotation, rotation_log, skew
from mapper.graph.model import BetweenFactor, PoseGraph


def distribute(graph: PoseGraph) -> dict[int, Transform]:
    """Return the estimates after the error of every loop was distributed, in the order in which they closed.

    Args:
        graph: Nodes in time order; only factors of origin "loop" are used.

    Returns:
        T_world_node of every node, in the graph's order.
    """
    order = {node: place for place, node in enumerate(graph.T_world_node)}
    T_world_node = dict(graph.T_world_node)
    for loop in sorted(graph.loops, key=lambda loop: max(order[loop.i], order[loop.j])):
        T_world_node = spread(T_world_node, loop)
    return T_world_node


def spread(T_world_node: Mapping[int, Transform], loop: BetweenFactor) -> dict[int, Transform]:
    """Return poses that satisfy a loop, its error distributed in proportion to the path length.

    The later node j takes the pose T_world_i · T_i_j: a translation Δt and a rotation ΔR.
    A node between takes f · Δt and exp(f · log ΔR), f being its share of the path's length from i to j.
    Nodes up to i keep their poses; nodes after j move rigidly with j.

    Args:
        T_world_node: Poses of the nodes in time order.
        loop: Measured relative pose of two of them; either may be the later.

    Raises:
        GraphError: A node of the loop is not among the poses.
    """
    nodes = list(T_world_node)
    try:
        i, j = nodes.index(loop.i), nodes.index(loop.j)
    except ValueError:
        raise GraphError(
            f"loop {loop.i} → {loop.j}: not both nodes are among the {len(nodes)} poses"
        ) from None
    T_i_j = loop.T_i_j
    if i > j:
        i, j, T_i_j = j, i, inverse(T_i_j)
    poses = np.array([T_world_node[node] for node in nodes])
    wanted = poses[i] @ T_i_j
    shift = wanted[:3, 3] - poses[j, :3, 3]
    turn = rotation_log(wanted[:3, :3] @ poses[j, :3, :3].T)
    after = wanted @ inverse(poses[j]) @ poses[j + 1 :]
    share = _shares(poses[i : j + 1, :3, 3])
    poses[i : j + 1, :3, :3] = _turns(share, turn) @ poses[i : j + 1, :3, :3]
    poses[i : j + 1, :3, 3] += share[:, np.newaxis] * shift
    poses[j] = wanted
    poses[j + 1 :] = after
    # Rounding errors of successive loops multiply, and a transpose is no inverse off SO(3): without the
    # projection the path diverges after about fifty loops.
    poses[i:, :3, :3] = nearest_rotation(poses[i:, :3, :3])
    return dict(zip(nodes, poses, strict=True))


def _shares(positions: Array) -> Array:
    """Return the share of the path length up to each of (N, 3) positions, 0 … 1.

    Where nothing moved, every step counts the same.
    """
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    path = np.cumsum(steps_m if steps_m.sum() > 0.0 else np.ones_like(steps_m))
    return np.concatenate([[0.0], path / path[-1]])


def _turns(share: Array, rotation_rad: Array) -> Array:
    """Return the (N, 3, 3) rotations exp(share · rotation) (Rodrigues 1840)."""
    angle_rad = float(np.linalg.norm(rotation_rad))
    K = skew(rotation_rad / angle_rad) if angle_rad > 0.0 else np.zeros((3, 3))
    angles_rad = share[:, np.newaxis, np.newaxis] * angle_rad
    return np.eye(3) + np.sin(angles_rad) * K + (1.0 - np.cos(angles_rad)) * (K @ K)
