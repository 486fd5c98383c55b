import numpy as np
import pytest

from mapper.core.errors import GraphError
from mapper.core.geometry import exp, inverse, transform
from mapper.graph.components import components
from mapper.graph.config import GraphConfig
from mapper.graph.g2o import read_g2o
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.graph.optimize import optimize
from tests.support.noisy_graphs import noisy_measure, odometry_chain, winding_street, wrong_alignment
from tests.support.paths import POSE_GRAPHS
from tests.support.planar import on_a_circle
from tests.support.progress import Observer

needs_posegraphs = pytest.mark.skipif(not POSE_GRAPHS.is_dir(), reason=f"{POSE_GRAPHS} is not here")

INFORMATION = PoseSigmas(rotation_rad=0.01, translation_m=0.02).information


def loop(n=12, *, first=0, rng=None):
    """A closed loop of exact measurements; with rng, estimates off by some 5 cm and 3°."""
    truth = on_a_circle(n, radius_m=2.0)
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


@pytest.mark.parametrize("initial", ["given", "chordal"])
def test_a_fixed_node_keeps_its_pose_in_place_of_the_first(initial):
    graph, truth = loop(rng=np.random.default_rng(1))
    graph.fixed = (7,)
    solution = optimize(graph, GraphConfig(initial=initial))
    T_new_old = graph.T_world_node[7] @ inverse(truth[7])
    for node, T in enumerate(truth):
        np.testing.assert_allclose(solution.T_world_node[node], T_new_old @ T, atol=1e-7)


def test_further_fixed_nodes_of_a_component_are_noted():
    observer = Observer()
    graph, _ = loop(rng=np.random.default_rng(1))
    graph.fixed = (7, 3)
    optimize(graph, GraphConfig(), progress=observer)
    assert observer.notes == ["of 2 connected nodes that are fixed only node 7 keeps its pose"]


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


def laps(lap=80, *, seed=0, false=0, too_confident=1.0):
    """Three rounds with drift and loops to the first; then false ones: clusters of four, each consistent."""
    rng = np.random.default_rng(seed)
    sigmas, loop_sigmas = PoseSigmas(0.002, 0.005), PoseSigmas(0.005, 0.01)
    truth = 3 * on_a_circle(lap, radius_m=2.0)
    n = len(truth)

    measured = noisy_measure(truth, rng, too_confident=too_confident)
    graph = odometry_chain(truth, measured, sigmas)
    ends = [(j % lap, j) for j in range(lap, n, 10)]
    T_i_js = [measured(i, j, loop_sigmas) for i, j in ends]
    for start in range(0, false, 4):
        i, j = np.sort(rng.choice(n - 4, 2, replace=False)).tolist()
        wrong = exp(rng.normal(0, 0.3, 3), rng.normal(0, 1, 3))
        for *pair, T in wrong_alignment(truth, i, j, wrong, min(4, false - start)):
            ends.append(tuple(pair))
            T_i_js.append(T)
    graph.add_factors(
        BetweenFactor(i, j, T, loop_sigmas.information, "loop")
        for (i, j), T in zip(ends, T_i_js, strict=True)
    )
    return graph, truth, len(ends) - false


def worst_m(solution, truth):
    return max(np.linalg.norm(solution.T_world_node[k][:3, 3] - T[:3, 3]) for k, T in enumerate(truth))


@pytest.mark.parametrize("false", [1, 3, 8])
@pytest.mark.parametrize("seed", range(3))
def test_false_loops_are_found_out_and_change_nothing(false, seed):
    graph, truth, true = laps(seed=seed, false=false)
    without = optimize(laps(seed=seed)[0], GraphConfig())
    solution = optimize(graph, GraphConfig())
    weights = np.array(solution.weights)
    loops = weights[239:]
    assert (weights[:239] == 1.0).all()
    assert (loops[true:] == 0.0).all()
    assert loops[:true].mean() > 0.95
    assert worst_m(solution, truth) < 1.1 * worst_m(without, truth)


def test_without_doubt_a_false_loop_bends_the_map():
    graph, truth, _ = laps(false=1)
    doubting, plain = (
        optimize(graph, GraphConfig(robust=robust, initial="given", max_iterations=20))
        for robust in ("gnc", "none")
    )
    assert worst_m(plain, truth) > 2.0 * worst_m(doubting, truth)


def test_over_confident_information_does_not_cost_the_true_loops():
    """Features that count as independent make sigmas five times too small: a fixed limit refuses all."""
    graph, _, true = laps(seed=1, false=5, too_confident=5.0)
    loops = np.array(optimize(graph, GraphConfig()).weights)[239:]
    assert loops[:true].mean() > 0.9
    assert (loops[true:] < 0.5).all()


@pytest.mark.parametrize("kernel", ["cauchy", "huber", "dcs"])
def test_kernels_weigh_a_false_loop_down_and_leave_odometry_alone(kernel):
    graph, _, true = laps(seed=2, false=1)
    solution = optimize(graph, GraphConfig(robust=kernel))
    weights = np.array(solution.weights)
    assert (weights[:239] == 1.0).all()
    assert weights[-1] < 0.5
    assert weights[239 : 239 + true].mean() > 0.6
    assert solution.error_after == pytest.approx(np.dot(solution.weights, solution.factor_errors))


def test_a_wider_kernel_lets_more_count():
    graph, _, _ = laps(seed=2, false=1)
    narrow, wide = (
        optimize(graph, GraphConfig(robust="cauchy", robust_width=w)).weights[-1] for w in (1, 50)
    )
    assert narrow < wide


def test_a_loop_between_parts_that_odometry_does_not_tie_is_believed():
    a, truth = loop(8)
    both = merged(a, loop(6, first=100)[0])
    T_0_100 = inverse(truth[0]) @ both.T_world_node[100]
    both.add_factors([BetweenFactor(0, 100, T_0_100, INFORMATION, "loop")])
    assert optimize(both, GraphConfig()).weights[-1] == 1.0


@pytest.mark.parametrize("initial", ["auto", "chordal"])
def test_a_start_without_estimates_is_found(initial):
    graph, truth = loop(40)
    lost = PoseGraph()
    rng = np.random.default_rng(6)
    for node, T in graph.T_world_node.items():
        lost.add_node(node, node, exp(rng.normal(0, 2, 3), rng.normal(0, 9, 3)) if node else T)
    lost.add_factors(graph.factors)
    solution = optimize(lost, GraphConfig(initial=initial))
    assert solution.error_after < 1e-9
    for node, T in enumerate(truth):
        np.testing.assert_allclose(solution.T_world_node[node], T, atol=1e-7)


def test_auto_keeps_estimates_that_fit():
    graph, _ = loop(rng=np.random.default_rng(7))
    near = optimize(graph, GraphConfig()).T_world_node
    good = PoseGraph(near, graph.stamps_ns, graph.factors)
    auto, given = (optimize(good, GraphConfig(initial=initial)) for initial in ("auto", "given"))
    assert all((auto.T_world_node[node] == given.T_world_node[node]).all() for node in near)


def test_the_iterations_are_reported():
    observer = Observer()
    graph, _ = loop(rng=np.random.default_rng(8))
    solution = optimize(graph, GraphConfig(initial="given"), progress=observer)
    assert observer.reached == {"solve": (solution.iterations, solution.iterations)}
    assert observer.notes == []


def test_damped_steps_go_on_until_the_error_is_least():
    """GTSAM's own limit ends its search for a damping where a step raises the error by up to 1e-5 of it."""
    graph = winding_street(900, seed=8)
    solution = optimize(graph, GraphConfig())
    further = optimize(graph.with_poses(solution.T_world_node), GraphConfig())
    assert solution.error_after == pytest.approx(further.error_after, rel=1e-6)


@pytest.mark.parametrize(("limit", "noted"), [(2, 1), (100, 0)])
def test_a_solve_that_did_not_converge_says_so(limit, noted):
    observer = Observer()
    graph, _ = loop(rng=np.random.default_rng(8))
    optimize(graph, GraphConfig(initial="given", max_iterations=limit), progress=observer)
    sentence = "the solve of 12 nodes was ended by max_iterations=2, not by convergence; raise it"
    assert observer.notes == [sentence] * noted


@needs_posegraphs
@pytest.mark.parametrize(
    ("name", "best"),
    [
        ("tinyGrid3D", 9.3139094),
        ("smallGrid3D", 517.92533),
        ("intel", 22.502117),
        ("parking-garage", 0.6341924),
        ("sphere2500", 675.70096),
        ("torus3D", 12117.637),
        pytest.param("cubicle", 1372.7779, marks=pytest.mark.slow),
    ],
)
def test_reaches_the_published_cost_from_file_initialisation(name, best):
    solution = optimize(read_g2o(POSE_GRAPHS / f"{name}.g2o"), GraphConfig())
    assert solution.error_after == pytest.approx(best, rel=1e-6)
    assert sum(solution.factor_errors) == pytest.approx(best, rel=1e-6)
    if name == "intel":  # planar, and lifted
        assert max(abs(T[2, 3]) for T in solution.T_world_node.values()) < 1e-9
