"""Loops between two sessions where odometry drifts more than it claims, and some of the loops are wrong."""

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse, transform
from mapper.graph.components import align_components
from mapper.graph.config import GraphConfig
from mapper.graph.drift import innovations
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.graph.optimize import optimize

NODES, LAP = 120, 40
SPLIT = 2 * LAP
"""First node of the second session."""
CLAIMED = PoseSigmas(rotation_rad=0.001, translation_m=0.002).information
BIAS = exp(np.array([0.0, 0.0, 0.001]), np.array([0.001, 0.0, 0.0]))
TRUTH = [
    exp(np.array([0.0, 0.0, 2.0 * np.pi * k / LAP]), np.zeros(3)) @ transform(np.eye(3), [3.0, 0.0, 0.0])
    for k in range(NODES)
]
T_OTHER_WORLD = exp(np.array([0.0, 0.0, 2.0]), np.array([5.0, 5.0, 0.0]))


def measured(i, j, rng, *, sigma, origin):
    error = exp(rng.normal(0.0, sigma, 3), rng.normal(0.0, 2.0 * sigma, 3))
    return BetweenFactor(i, j, inverse(TRUTH[i]) @ TRUTH[j] @ error, CLAIMED, origin)


def odometry(rng):
    """Three laps in two sessions, every step biased."""
    graph = PoseGraph()
    for k in range(NODES):
        if k in (0, SPLIT):
            graph.add_node(k, k, TRUTH[0] if k == 0 else T_OTHER_WORLD)
            continue
        step = measured(k - 1, k, rng, sigma=0.001, origin="odometry")
        step = BetweenFactor(k - 1, k, step.T_i_j @ BIAS, CLAIMED)
        graph.add_node(k, k, graph.T_world_node[k - 1] @ step.T_i_j)
        graph.add_factors([step])
    return graph


def true_loops(nodes, rng):
    return [measured(j - LAP, j, rng, sigma=0.002, origin="loop") for j in nodes]


def false_loops(count, rng):
    ends = zip(
        rng.integers(0, SPLIT, count).tolist(), rng.integers(SPLIT, NODES, count).tolist(), strict=True
    )
    return [
        BetweenFactor(i, j, exp(rng.normal(0.0, 0.3, 3), rng.normal(0.0, 0.5, 3)), CLAIMED, "loop")
        for i, j in ends
    ]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("false", [0, 6])
def test_loops_between_sessions_are_judged_by_the_drift_that_loops_show(seed, false):
    """If those between the sessions counted as no drift at all, true loops would look impossible."""
    rng = np.random.default_rng(seed)
    graph = odometry(rng)
    wrong = false_loops(false, rng)
    right = true_loops(range(LAP + 3, SPLIT, 5), rng) + true_loops(range(SPLIT, NODES, 2), rng)
    graph.add_factors([*wrong, *right])

    solution = optimize(align_components(graph), GraphConfig())

    weights = np.array(solution.weights[-len(wrong) - len(right) :])
    np.testing.assert_array_equal(weights[:false], 0.0)
    np.testing.assert_array_equal(weights[false:], 1.0)
    worst_m = max(np.linalg.norm(solution.T_world_node[k][:3, 3] - TRUTH[k][:3, 3]) for k in range(NODES))
    assert worst_m < 0.1


def test_a_false_loop_between_sessions_stands_out_wherever_it_is_listed():
    rng = np.random.default_rng(1)
    known = odometry(rng).factors
    wrong, right = false_loops(2, rng), true_loops(range(SPLIT, NODES, 4), rng)
    for loops in ([*wrong, *right], [*right, *wrong]):
        apart = dict(zip(map(id, loops), innovations(known, loops), strict=True))
        assert min(apart[id(loop)] for loop in wrong) > 10.0 * max(apart[id(loop)] for loop in right)
