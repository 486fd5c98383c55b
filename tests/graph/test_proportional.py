from itertools import pairwise

import numpy as np
import pytest

from mapper.core.errors import GraphError
from mapper.core.geometry import exp, inverse, is_rigid, rotation_exp, rotation_log, transform
from mapper.graph.config import GraphConfig
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.graph.optimize import optimize
from mapper.graph.proportional_correction import distribute, spread

INFORMATION = np.eye(6)


def walk(steps_m):
    """Node k has walked the first k steps along x."""
    return {k: transform(np.eye(3), [x, 0.0, 0.0]) for k, x in enumerate(np.cumsum([0.0, *steps_m]))}


def graph_of(T_world_node, *loops):
    graph = PoseGraph()
    for node, T in T_world_node.items():
        graph.add_node(node, 1000 + node, T)
    nodes = list(T_world_node)
    graph.add_factors(
        BetweenFactor(i, j, inverse(T_world_node[i]) @ T_world_node[j], INFORMATION)
        for i, j in pairwise(nodes)
    )
    graph.add_factors(loops)
    return graph


def loop(i, j, T_i_j):
    return BetweenFactor(i, j, T_i_j, INFORMATION, "loop")


def test_each_node_takes_its_share_of_the_way():
    T_world_node = walk([1.0, 1.0, 2.0, 4.0, 5.0])
    shift, turn = np.array([0.0, 0.8, 0.0]), np.array([0.0, 0.0, 0.4])
    T_world_4 = transform(rotation_exp(turn), T_world_node[4][:3, 3] + shift)

    spread_out = spread(T_world_node, loop(1, 4, inverse(T_world_node[1]) @ T_world_4))

    for node in (0, 1):
        np.testing.assert_array_equal(spread_out[node], T_world_node[node])
    for node, share in ((2, 1 / 7), (3, 3 / 7), (4, 1.0)):
        moved = spread_out[node][:3, 3] - T_world_node[node][:3, 3]
        np.testing.assert_allclose(moved, share * shift, atol=1e-12)
        np.testing.assert_allclose(rotation_log(spread_out[node][:3, :3]), share * turn, atol=1e-12)


def test_the_later_node_fulfils_the_loop_and_the_rest_follows_rigidly():
    rng = np.random.default_rng(0)
    T_world_node = {k: exp(rng.normal(0, 1, 3), rng.normal(0, 3, 3)) for k in range(8)}
    closing = loop(2, 5, exp(rng.normal(0, 1, 3), rng.normal(0, 1, 3)))

    spread_out = spread(T_world_node, closing)

    np.testing.assert_allclose(inverse(spread_out[2]) @ spread_out[5], closing.T_i_j, atol=1e-12)
    for node in (6, 7):
        np.testing.assert_allclose(
            inverse(spread_out[5]) @ spread_out[node],
            inverse(T_world_node[5]) @ T_world_node[node],
            atol=1e-12,
        )


def test_a_loop_says_the_same_from_either_end():
    rng = np.random.default_rng(1)
    T_world_node = {k: exp(rng.normal(0, 1, 3), rng.normal(0, 3, 3)) for k in range(6)}
    T_1_4 = exp(rng.normal(0, 1, 3), rng.normal(0, 1, 3))
    there, back = spread(T_world_node, loop(1, 4, T_1_4)), spread(T_world_node, loop(4, 1, inverse(T_1_4)))
    for node in T_world_node:
        np.testing.assert_allclose(there[node], back[node], atol=1e-12)


def test_on_the_spot_every_step_counts_the_same():
    T_world_node = {k: np.eye(4) for k in range(5)}
    spread_out = spread(T_world_node, loop(0, 4, transform(np.eye(3), [0.0, 0.0, 1.0])))
    heights_m = [T[2, 3] for T in spread_out.values()]
    np.testing.assert_allclose(heights_m, [0.0, 0.25, 0.5, 0.75, 1.0], atol=1e-12)


def test_loops_are_spread_in_the_order_in_which_they_closed():
    T_world_node = walk([1.0] * 6)
    early = loop(0, 3, transform(np.eye(3), [3.0, 0.3, 0.0]))
    late = loop(1, 6, transform(np.eye(3), [5.0, 0.0, 0.2]))

    apart = spread(spread(T_world_node, early), late)
    together = distribute(graph_of(T_world_node, late, early))

    for node in T_world_node:
        np.testing.assert_array_equal(together[node], apart[node])


def test_the_proportional_solve_believes_every_loop_and_says_how_well_it_fits():
    closing = loop(0, 4, transform(np.eye(3), [3.6, 0.0, 0.0]))
    graph = graph_of(walk([1.0] * 4), closing)
    solution = optimize(graph, GraphConfig(solve="proportional"))
    assert solution.T_world_node[4][0, 3] == pytest.approx(3.6)
    assert solution.weights == (1.0,) * 5
    assert solution.error_before == pytest.approx(0.5 * 0.4**2)
    assert solution.error_after == pytest.approx(4 * 0.5 * 0.1**2)
    assert solution.iterations == 0


def test_a_loop_to_an_unknown_node_is_refused():
    with pytest.raises(GraphError, match="loop 0 → 9: not both nodes are among the 3 poses"):
        spread(walk([1.0, 1.0]), loop(0, 9, np.eye(4)))


def test_many_loops_leave_rotations_rotations():
    """Products of poses drift off SO(3); without a projection sixty loops make the path burst."""
    rng = np.random.default_rng(2)
    T_world_node = {k: exp(rng.normal(0, 0.3, 3), rng.normal(0, 1, 3)) for k in range(70)}
    for j in range(5, 65):
        i = int(rng.integers(0, j - 4))
        T_world_node = spread(T_world_node, loop(i, j, exp(rng.normal(0, 0.5, 3), rng.normal(0, 1, 3))))

    assert is_rigid(np.array(list(T_world_node.values())), tolerance=1e-12)
