import numpy as np
import pytest

from mapper.core.errors import GraphError
from mapper.core.geometry import exp, inverse, transform
from mapper.graph.config import GraphConfig
from mapper.graph.incremental import IncrementalSolver
from mapper.graph.marginals import marginals_of
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.graph.optimize import optimize
from tests.support.planar import on_a_circle

SIGMAS = PoseSigmas(rotation_rad=0.005, translation_m=0.01)


def measured(truth, i, j, rng, origin="odometry"):
    error = exp(rng.normal(0, SIGMAS.rotation_rad, 3), rng.normal(0, SIGMAS.translation_m, 3))
    return BetweenFactor(i, j, inverse(truth[i]) @ truth[j] @ error, SIGMAS.information, origin)


def grown(n=80, *, seed=0):
    """Two rounds, every node hung on the believed pose of the last, and loops to the first round."""
    rng = np.random.default_rng(seed)
    truth = on_a_circle(n, radius_m=3.0, rounds=2)
    solver, graph = IncrementalSolver(), PoseGraph()
    solver.add_node(0, truth[0])
    graph.add_node(0, 0, truth[0])
    for k in range(1, n):
        step = measured(truth, k - 1, k, rng)
        T_world_k = solver.pose_of(k - 1) @ step.T_i_j
        factors = [step]
        if k >= n // 2 and k % 5 == 0:
            factors.append(measured(truth, k - n // 2, k, rng, "loop"))
        solver.add_node(k, T_world_k)
        solver.add_factors(factors)
        solver.update()
        graph.add_node(k, k, T_world_k)
        graph.add_factors(factors)
    return solver, graph, truth


def gap_m(poses, others):
    return max(np.linalg.norm(T[:3, 3] - others[node][:3, 3]) for node, T in poses.items())


def test_growing_arrives_where_the_batch_solve_does():
    solver, graph, truth = grown()
    batch = optimize(graph, GraphConfig(robust="huber")).T_world_node
    assert gap_m(solver.poses(), batch) < 0.01
    assert gap_m(solver.poses(), dict(enumerate(truth))) < 0.25
    assert list(solver.poses()) == list(graph.T_world_node)
    np.testing.assert_allclose(solver.pose_of(33), solver.poses()[33], atol=1e-12)


def test_what_waits_is_where_it_was_put():
    solver = IncrementalSolver()
    T_world_7 = transform(np.eye(3), [1.0, 2.0, 3.0])
    solver.add_node(7, T_world_7)
    solver.update()
    np.testing.assert_array_equal(solver.pose_of(7), T_world_7)
    solver.add_node(8, np.eye(4))
    solver.add_factors([BetweenFactor(7, 8, np.eye(4), np.eye(6))])
    np.testing.assert_array_equal(solver.poses()[8], np.eye(4))
    solver.update()
    np.testing.assert_allclose(solver.poses()[8], T_world_7, atol=1e-6)
    np.testing.assert_allclose(solver.poses()[7], T_world_7, atol=1e-6)


def test_a_false_loop_pulls_less_than_a_believed_measurement():
    """Ten loops agree, one is 2 m off: Huber's kernel bounds how hard it can pull."""

    def end_m(origin):
        solver = IncrementalSolver()
        for k in range(2):
            solver.add_node(k, np.eye(4))
        right = [BetweenFactor(0, 1, np.eye(4), SIGMAS.information, "loop")] * 10
        wrong = BetweenFactor(0, 1, transform(np.eye(3), [2.0, 0.0, 0.0]), SIGMAS.information, origin)
        solver.add_factors([*right, wrong])
        for _ in range(10):
            solver.add_factors([right[0]])
            solver.update()
        return solver.pose_of(1)[0, 3]

    assert end_m("loop") < 0.01
    assert end_m("odometry") > 0.05


def test_components_are_anchored_apart_until_a_loop_joins_them():
    """After a loss the map goes on elsewhere; the loop takes the younger part to the older."""
    rng = np.random.default_rng(2)
    truth = on_a_circle(30, radius_m=3.0, rounds=2)
    T_wrong_world = exp(np.array([0.1, 0.2, 1.5]), np.array([5.0, -3.0, 1.0]))
    solver = IncrementalSolver()
    for k in range(30):
        T_put = truth[k] if k < 15 else T_wrong_world @ truth[k]
        solver.add_node(k, T_put)
        if k not in (0, 15):
            solver.add_factors([measured(truth, k - 1, k, rng)])
        solver.update()
    np.testing.assert_allclose(solver.pose_of(0), truth[0], atol=1e-9)
    np.testing.assert_allclose(solver.pose_of(15), T_wrong_world @ truth[15], atol=1e-9)

    solver.add_factors([measured(truth, 20, 4, rng, "loop")])
    solver.update()

    np.testing.assert_allclose(solver.pose_of(0), truth[0], atol=1e-9)
    assert gap_m(solver.poses(), dict(enumerate(truth))) < 0.3


def test_a_loop_takes_along_a_component_that_still_waits():
    """A later session, none of whose factors was ever solved, begins where its first loop wants it."""
    rng = np.random.default_rng(4)
    truth = on_a_circle(30, radius_m=3.0, rounds=2)
    T_wrong_world = exp(np.array([0.1, 0.2, 3.0]), np.array([5.0, -3.0, 1.0]))
    solver = IncrementalSolver()
    for k in range(30):
        solver.add_node(k, truth[k] if k < 15 else T_wrong_world @ truth[k])
    solver.add_factors(measured(truth, k - 1, k, rng) for k in range(1, 15))
    solver.update()
    solver.add_factors(measured(truth, k - 1, k, rng) for k in range(16, 30))
    solver.add_factors([measured(truth, 4, 20, rng, "loop")])
    assert gap_m(solver.poses(), dict(enumerate(truth))) < 0.3
    solver.update()
    assert gap_m(solver.poses(), dict(enumerate(truth))) < 0.3


def test_joining_from_either_end_is_the_same():
    rng = np.random.default_rng(3)
    T_0_2 = exp(rng.normal(0, 1, 3), rng.normal(0, 1, 3))
    ties = (
        BetweenFactor(0, 2, T_0_2, SIGMAS.information, "loop"),
        BetweenFactor(2, 0, inverse(T_0_2), SIGMAS.information, "loop"),
    )
    for tie in ties:
        solver = IncrementalSolver()
        for k in range(4):
            solver.add_node(k, transform(np.eye(3), [float(k), 0.0, 0.0]))
        solver.add_factors(BetweenFactor(k, k + 1, np.eye(4), SIGMAS.information) for k in (0, 2))
        solver.update()
        solver.add_factors([tie])
        solver.update()
        np.testing.assert_allclose(solver.pose_of(2), T_0_2, atol=1e-6)
        np.testing.assert_allclose(solver.pose_of(3), T_0_2, atol=1e-6)


def test_what_does_not_belong_is_refused():
    solver = IncrementalSolver()
    solver.add_node(1, np.eye(4))
    with pytest.raises(GraphError, match="node 1 is in the graph already"):
        solver.add_node(1, np.eye(4))
    with pytest.raises(GraphError, match="node 2: its pose is not a finite rigid motion"):
        solver.add_node(2, np.full((4, 4), np.nan))
    with pytest.raises(GraphError, match="factor 1 → 9: node 9 is not in the graph"):
        solver.add_factors([BetweenFactor(1, 9, np.eye(4), np.eye(6))])
    with pytest.raises(GraphError, match="node 9 is not in the graph"):
        solver.pose_of(9)


ABSURD = [np.diag([1e25, 1e-25, 1.0, 1e25, 1e-25, 1.0]), 1e300 * np.eye(6)]


@pytest.mark.parametrize("information", ABSURD)
def test_absurd_information_is_one_line_and_no_exception_of_gtsam(information):
    solver, graph = IncrementalSolver(), PoseGraph()
    for node in range(3):
        solver.add_node(node, np.eye(4))
        graph.add_node(node, node, np.eye(4))
    factors = [BetweenFactor(0, 1, np.eye(4), np.eye(6)), BetweenFactor(1, 2, np.eye(4), information)]
    solver.add_factors(factors)
    graph.add_factors(factors)

    with pytest.raises(GraphError, match="the growing graph cannot be solved: Indeterminate") as growing:
        solver.update()
    with pytest.raises(GraphError, match="covariances of 3 nodes from node 0: Indeterminate") as known:
        marginals_of(graph)
    for caught in (growing, known):
        assert "\n" not in str(caught.value)
    for T_world_node in optimize(graph, GraphConfig()).T_world_node.values():  # needs no more than damping
        np.testing.assert_allclose(T_world_node, np.eye(4), atol=1e-9)


def test_a_long_straight_path_is_solved_when_a_loop_closes_it():
    rng, n = np.random.default_rng(5), 1500
    truth = [transform(np.eye(3), [0.3 * k, 0.0, 0.0]) for k in range(n)]
    sigmas = PoseSigmas(rotation_rad=0.001, translation_m=0.001)
    solver, graph = IncrementalSolver(), PoseGraph()
    T_world_node = truth[0]
    steps = list[BetweenFactor]()
    for k in range(n):
        if k:
            error = exp(rng.normal(0, 0.001, 3), rng.normal(0, 0.001, 3))
            T_step = inverse(truth[k - 1]) @ truth[k] @ error
            steps.append(BetweenFactor(k - 1, k, T_step, sigmas.information))
            T_world_node = T_world_node @ T_step
        solver.add_node(k, T_world_node)
        graph.add_node(k, k, T_world_node)
    solver.add_factors(steps)
    graph.add_factors(steps)
    drift_m = np.linalg.norm((T_world_node - truth[-1])[:3, 3])
    closing = BetweenFactor(0, n - 1, truth[-1], sigmas.information, "loop")
    solver.add_factors([closing])
    graph.add_factors([closing])
    for _ in range(3):
        solver.update()

    solution = optimize(graph, GraphConfig(robust="none"))
    assert drift_m > 5.0
    for solved in (solver.poses(), solution.T_world_node):
        assert np.linalg.norm((solved[n - 1] - truth[-1])[:3, 3]) < 0.1
    assert solution.iterations < 10
