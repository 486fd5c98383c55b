from pathlib import Path

import numpy as np
import pytest

from mapper.config.graph import GraphConfig
from mapper.errors import GraphError
from mapper.geometry import exp, inverse, transform
from mapper.graph.g2o import read_g2o
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.graph.optimize import components, optimize

POSEGRAPHS = Path(__file__).parents[2] / "shared/data/posegraph"
needs_posegraphs = pytest.mark.skipif(not POSEGRAPHS.is_dir(), reason=f"{POSEGRAPHS} is not here")

INFORMATION = PoseSigmas(rotation_rad=0.01, translation_m=0.02).information


def on_a_circle(n):
    angles = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    return [
        exp(np.array([0.0, 0.0, a]), np.zeros(3)) @ transform(np.eye(3), [2.0, 0.0, 0.1 * a]) for a in angles
    ]


def loop(n=12, *, first=0, rng=None):
    """A closed loop of exact measurements; with rng, estimates off by some 5 cm and 3°."""
    truth = on_a_circle(n)
    graph = PoseGraph()
    for k, T in enumerate(truth):
        error = exp(rng.normal(0, 0.05, 3), rng.normal(0, 0.05, 3)) if rng and k else np.eye(4)
        graph.add_node(first + k, 1000 + k, T @ error)
    pairs = [(k, (k + step) % n) for k in range(n) for step in (1, 2)]
    graph.add_factors(
        BetweenFactor(first + i, first + j, inverse(truth[i]) @ truth[j], INFORMATION) for i, j in pairs
    )
    return graph, truth


def merged(a, b):
    both = PoseGraph()
    for graph in (a, b):
        for node, T in graph.T_world_node.items():
            both.add_node(node, graph.stamps_ns[node], T)
        both.add_factors(graph.factors)
    return both


def test_recovers_a_perturbed_loop():
    graph, truth = loop(rng=np.random.default_rng(1))
    solution = optimize(graph, GraphConfig())
    assert list(solution.T_world_node) == list(range(12))
    for node, T in enumerate(truth):
        np.testing.assert_allclose(solution.T_world_node[node], T, atol=1e-7)
    assert solution.error_before > 10.0
    assert solution.error_after < 1e-9
    assert solution.iterations >= 1
    assert len(solution.factor_errors) == len(graph.factors)


def test_errors_are_half_chi_squared_in_our_tangent_order():
    graph = PoseGraph()
    graph.add_node(0, 0, np.eye(4))
    graph.add_node(1, 1, exp(np.array([0.0, 0.03, 0.0]), np.array([0.0, 0.0, 0.4])))
    graph.add_factors([BetweenFactor(0, 1, np.eye(4), np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))])
    solution = optimize(graph, GraphConfig(solve="none"))
    assert solution.error_after == pytest.approx(0.5 * (2.0 * 0.03**2 + 6.0 * 0.4**2))


def test_solving_none_returns_the_estimates_and_says_how_well_they_fit():
    graph, _ = loop(rng=np.random.default_rng(2))
    solution = optimize(graph, GraphConfig(solve="none"))
    assert all((solution.T_world_node[node] == T).all() for node, T in graph.T_world_node.items())
    assert solution.error_after == solution.error_before == pytest.approx(sum(solution.factor_errors))
    assert solution.iterations == 0


def test_a_heavy_factor_wins_over_a_light_one():
    graph = PoseGraph()
    graph.add_node(0, 0, np.eye(4))
    graph.add_node(1, 1, np.eye(4))
    near, far = transform(np.eye(3), [1.0, 0.0, 0.0]), transform(np.eye(3), [2.0, 0.0, 0.0])
    graph.add_factors([BetweenFactor(0, 1, near, 3.0 * np.eye(6)), BetweenFactor(0, 1, far, np.eye(6))])
    solution = optimize(graph, GraphConfig())
    assert solution.T_world_node[1][0, 3] == pytest.approx(1.25)
    assert solution.factor_errors == pytest.approx((0.5 * 3.0 * 0.25**2, 0.5 * 0.75**2))


def test_components_are_solved_apart_and_each_keeps_its_first_node():
    rng = np.random.default_rng(3)
    a, truth_a = loop(8, rng=rng)
    b, truth_b = loop(6, first=100, rng=rng)
    both = merged(a, b)
    both.add_node(500, 5000, transform(np.eye(3), [9.0, 9.0, 9.0]))

    solution = optimize(both, GraphConfig())

    assert components(both) == [list(range(8)), list(range(100, 106)), [500]]
    for first, truth in ((0, truth_a), (100, truth_b)):
        for k, T in enumerate(truth):
            np.testing.assert_allclose(solution.T_world_node[first + k], T, atol=1e-7)
    np.testing.assert_array_equal(solution.T_world_node[500], both.T_world_node[500])
    assert optimize(a, GraphConfig()).error_before + optimize(b, GraphConfig()).error_before == pytest.approx(
        solution.error_before
    )


def test_one_node_without_factors_is_its_own_solution():
    graph = PoseGraph()
    graph.add_node(7, 0, transform(np.eye(3), [1.0, 2.0, 3.0]))
    solution = optimize(graph, GraphConfig())
    np.testing.assert_array_equal(solution.T_world_node[7], graph.T_world_node[7])
    assert (solution.error_after, solution.iterations, solution.factor_errors) == (0.0, 0, ())


def test_the_graph_is_left_as_it_was_and_the_answer_repeats_to_the_bit():
    graph, _ = loop(30, rng=np.random.default_rng(4))
    before = {node: T.copy() for node, T in graph.T_world_node.items()}
    first, second = optimize(graph, GraphConfig()), optimize(graph, GraphConfig())
    assert all((graph.T_world_node[node] == T).all() for node, T in before.items())
    assert all((second.T_world_node[node] == T).all() for node, T in first.T_world_node.items())
    assert second.factor_errors == first.factor_errors


def test_rotations_that_are_off_by_rounding_are_survived():
    graph, _ = loop(rng=np.random.default_rng(5))
    rough = PoseGraph()
    for node, T in graph.T_world_node.items():
        stretched = T.copy()
        stretched[:3, :3] *= 1.0 + 2e-6
        rough.add_node(node, node, stretched)
    rough.add_factors(graph.factors)
    assert optimize(rough, GraphConfig()).error_after < 1e-9


def test_what_cannot_be_solved_is_said_in_one_line():
    with pytest.raises(GraphError, match="no nodes"):
        optimize(PoseGraph(), GraphConfig())
    graph, _ = loop()
    graph.T_world_node[3] = np.full((4, 4), np.nan)
    with pytest.raises(GraphError, match="node 3: its estimate is not a finite rigid motion"):
        optimize(graph, GraphConfig())


@needs_posegraphs
@pytest.mark.parametrize(
    ("name", "best"), [("tinyGrid3D", 9.3139094), ("smallGrid3D", 517.92533), ("sphere2500", 675.70096)]
)
def test_reaches_the_published_cost_from_file_initialisation(name, best):
    solution = optimize(read_g2o(POSEGRAPHS / f"{name}.g2o"), GraphConfig())
    assert solution.error_after == pytest.approx(best, rel=1e-7)
    assert sum(solution.factor_errors) == pytest.approx(best, rel=1e-7)
