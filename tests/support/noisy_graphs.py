"""Pose graphs as noisy odometry and a loop detector that errs would leave them."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

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
