"""Pose graphs as noisy odometry and a loop detector that errs would leave them."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.spatial import cKDTree

from mapper.core.geometry import Transform, exp, inverse
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas

Measure = Callable[[int, int, PoseSigmas], Transform]
"""Returns T_i_j of two nodes as measured with the sigmas."""


def noisy_measure(
    truth: Sequence[Transform], rng: np.random.Generator, *, too_confident: float = 1.0
) -> Measure:
    """Return a measure whose errors are ``too_confident`` times larger than the sigmas say."""

    def measured(i: int, j: int, sigmas: PoseSigmas) -> Transform:
        error = exp(
            rng.normal(0.0, too_confident * sigmas.rotation_rad, 3),
            rng.normal(0.0, too_confident * sigmas.translation_m, 3),
        )
        return inverse(truth[i]) @ truth[j] @ error

    return measured


def odometry_chain(truth: Sequence[Transform], measured: Measure, sigmas: PoseSigmas) -> PoseGraph:
    """Return a graph of measured steps between neighbours, which lead from the first true pose."""
    graph = PoseGraph()
    graph.add_node(0, 0, truth[0])
    for k in range(1, len(truth)):
        T_before_here = measured(k - 1, k, sigmas)
        graph.add_node(k, k, graph.T_world_node[k - 1] @ T_before_here)
        graph.add_factors([BetweenFactor(k - 1, k, T_before_here, sigmas.information)])
    return graph


def wrong_alignment(
    truth: Sequence[Transform], i: int, j: int, T_i_j: Transform, size: int
) -> Iterator[tuple[int, int, Transform]]:
    """Yield (i + k, j + k, T_ik_jk): one wrong alignment of two stretches of the way."""
    for k in range(size):
        yield i + k, j + k, inverse(truth[i + k]) @ truth[i] @ T_i_j @ inverse(truth[j]) @ truth[j + k]


def winding_street(n: int, seed: int) -> PoseGraph:
    """Return a planar path of n steps of 1 m along blocks, with headings off by 0.2 rad, and revisits."""
    rng = np.random.default_rng(seed)
    noise = PoseSigmas(rotation_rad=0.2, translation_m=0.05)
    truth = [np.eye(4)]
    for k in range(1, n):
        turn = rng.choice([0.0, 0.5 * np.pi, -0.5 * np.pi], p=[0.5, 0.25, 0.25]) if k % 4 == 0 else 0.0
        truth.append(truth[-1] @ exp(np.array([0.0, 0.0, turn]), np.array([1.0, 0.0, 0.0])))

    def measured(i: int, j: int) -> BetweenFactor:
        error = exp(np.array([0.0, 0.0, rng.normal(0.0, 0.2)]), np.array([*rng.normal(0.0, 0.05, 2), 0.0]))
        return BetweenFactor(i, j, inverse(truth[i]) @ truth[j] @ error, noise.information)

    graph = PoseGraph()
    graph.add_node(0, 0, truth[0])
    for k in range(1, n):
        step = measured(k - 1, k)
        graph.add_node(k, k, graph.T_world_node[k - 1] @ step.T_i_j)
        graph.add_factors([step])
    near = cKDTree([T[:3, 3] for T in truth]).query_pairs(1.5, output_type="ndarray")
    near = near[near[:, 1] - near[:, 0] > 10]
    graph.add_factors(measured(int(i), int(j)) for i, j in rng.permutation(near)[: int(0.3 * n)])
    return graph
