"""Covariances of nodes: those of the dense inverse, for every connected component."""

import gtsam
import numpy as np
import pytest

from mapper.core.errors import GraphError
from mapper.core.geometry import Transform, exp, inverse, log
from mapper.graph.marginals import node_covariances
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.graph.terms import between, values_of
from tests.support.noisy_graphs import noisy_measure, odometry_chain

SIGMAS = PoseSigmas(rotation_rad=0.01, translation_m=0.03)


def walk(count: int, rng: np.random.Generator) -> list[Transform]:
    poses = [exp(np.array([0.3, -0.2, 1.0]), np.array([3.0, -1.0, 0.5]))]
    for _ in range(count - 1):
        poses.append(poses[-1] @ exp(rng.normal(0.0, 0.2, 3), np.array([0.5, 0.0, 0.1])))
    return poses


def graph_with_loops(count: int, loops: int, seed: int = 0) -> PoseGraph:
    rng = np.random.default_rng(seed)
    truth = walk(count, rng)
    measured = noisy_measure(truth, rng)
    graph = odometry_chain(truth, measured, SIGMAS)
    for _ in range(loops):
        i, j = sorted(rng.choice(count, 2, replace=False).tolist())
        A = rng.normal(size=(6, 6))
        information = SIGMAS.information + 1e3 * A @ A.T
        graph.add_factors([BetweenFactor(i, j, measured(i, j, SIGMAS), information, "loop")])
    return graph


def dense(graph: PoseGraph, held: int) -> dict[int, np.ndarray]:
    """The blocks of the inverse of the information, without the rows of the node that is held."""
    problem = gtsam.NonlinearFactorGraph()
    for factor in graph.factors:
        problem.add(between(factor))
    nodes = [node for node in graph.T_world_node if node != held]
    order = gtsam.Ordering()
    for node in [held, *nodes]:
        order.push_back(node)
    information = problem.linearize(values_of(graph.T_world_node, graph.T_world_node)).hessian(order)[0]
    covariance = np.linalg.inv(information[6:, 6:])
    return {node: covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k, node in enumerate(nodes)}


@pytest.mark.parametrize(("count", "loops"), [(2, 0), (12, 0), (40, 6), (60, 80)])
def test_they_are_those_of_the_dense_inverse(count, loops):
    graph = graph_with_loops(count, loops)
    found, expected = node_covariances(graph), dense(graph, 0)
    np.testing.assert_array_equal(found[0], np.zeros((6, 6)))
    assert found.keys() == graph.T_world_node.keys()
    for node, covariance in expected.items():
        np.testing.assert_allclose(found[node], covariance, rtol=1e-4, atol=1e-9)
        np.testing.assert_array_equal(found[node], found[node].T)


def test_every_component_is_held_at_its_own_first_node():
    first, second = graph_with_loops(20, 3), graph_with_loops(15, 2, seed=1)
    moved = [BetweenFactor(f.i + 100, f.j + 100, f.T_i_j, f.information, f.origin) for f in second.factors]
    both = PoseGraph(
        first.T_world_node | {node + 100: T for node, T in second.T_world_node.items()} | {500: np.eye(4)},
        {},
        [*first.factors, *moved],
    )
    found = node_covariances(both)
    for node, covariance in node_covariances(first).items():
        np.testing.assert_allclose(found[node], covariance, rtol=1e-6, atol=1e-12)
    for node, covariance in node_covariances(second).items():
        np.testing.assert_allclose(found[node + 100], covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(found[500], np.zeros((6, 6)))


def test_errors_of_many_draws_spread_as_it_says():
    rng = np.random.default_rng(3)
    truth = walk(8, rng)
    errors = []
    for _ in range(400):
        graph = odometry_chain(truth, noisy_measure(truth, rng), SIGMAS)
        errors.append(np.concatenate(log(inverse(truth[7]) @ graph.T_world_node[7])))
    spread = np.cov(np.array(errors).T)
    chain = odometry_chain(truth, lambda i, j, _: inverse(truth[i]) @ truth[j], SIGMAS)
    ratio = np.diag(spread) / np.diag(node_covariances(chain)[7])
    assert (ratio > 0.75).all()
    assert (ratio < 1.3).all()


def test_the_world_s_axes_do_not_matter():
    graph = graph_with_loops(15, 3)
    moved = graph.moved(exp(np.array([0.4, 1.0, -2.0]), np.array([5.0, 1.0, 2.0])))
    for before, after in zip(node_covariances(graph).values(), node_covariances(moved).values(), strict=True):
        np.testing.assert_allclose(before, after, rtol=1e-6, atol=1e-12)


def test_a_pose_that_is_not_finite_is_refused():
    graph = graph_with_loops(5, 0)
    graph.T_world_node[3] = np.full((4, 4), np.nan)
    with pytest.raises((GraphError, RuntimeError)):
        node_covariances(graph)
