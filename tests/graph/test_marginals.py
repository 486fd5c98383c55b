"""Covariances of nodes: those of the dense inverse, for every connected component."""

import gtsam
import numpy as np
import pytest

from mapper.core.geometry import Transform, adjoint, exp, inverse, log
from mapper.graph.gtsam_factors import between, values_of
from mapper.graph.marginals import marginals_of
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
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
    found, expected = marginals_of(graph).nodes, dense(graph, 0)
    np.testing.assert_array_equal(found[0], np.zeros((6, 6)))
    assert found.keys() == graph.T_world_node.keys()
    for node, covariance in expected.items():
        np.testing.assert_allclose(found[node], covariance, rtol=1e-4, atol=1e-9)
        np.testing.assert_array_equal(found[node], found[node].T)


@pytest.mark.parametrize("loops", [0, 25])
def test_relative_covariances_are_those_of_the_joint_covariance(loops):
    graph = graph_with_loops(30, loops)
    problem = gtsam.NonlinearFactorGraph()
    for factor in graph.factors:
        problem.add(between(factor))
    values = values_of(graph.T_world_node, graph.T_world_node)
    problem.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    joint = gtsam.Marginals(problem, values)
    relative = marginals_of(graph).relative
    assert set(relative) == {(factor.i, factor.j) for factor in graph.factors}
    for (i, j), found in relative.items():
        both = joint.jointMarginalCovariance(gtsam.KeyVector([i, j])).fullMatrix()
        to_j = adjoint(inverse(graph.T_world_node[j]) @ graph.T_world_node[i])
        change = np.hstack([-to_j, np.eye(6)])
        np.testing.assert_allclose(found, change @ both @ change.T, rtol=1e-4, atol=1e-9)
        if not loops:
            np.testing.assert_allclose(found, np.linalg.inv(SIGMAS.information), rtol=1e-3, atol=1e-8)


def test_every_component_is_held_at_its_own_first_node():
    first, second = graph_with_loops(20, 3), graph_with_loops(15, 2, seed=1)
    moved = [BetweenFactor(f.i + 100, f.j + 100, f.T_i_j, f.information, f.origin) for f in second.factors]
    both = PoseGraph(
        first.T_world_node | {node + 100: T for node, T in second.T_world_node.items()} | {500: np.eye(4)},
        {},
        [*first.factors, *moved],
    )
    found = marginals_of(both).nodes
    for node, covariance in marginals_of(first).nodes.items():
        np.testing.assert_allclose(found[node], covariance, rtol=1e-6, atol=1e-12)
    for node, covariance in marginals_of(second).nodes.items():
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
    ratio = np.diag(spread) / np.diag(marginals_of(chain).nodes[7])
    assert (ratio > 0.75).all()
    assert (ratio < 1.3).all()
