"""What the record of a solve says about its loops."""

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse, transform
from mapper.graph.config import GraphConfig
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.pipeline.solve import solve
from tests.support.loop_closures import loop

STEP = PoseSigmas(rotation_rad=0.002, translation_m=0.005)
NODES = 40


def circle() -> list[np.ndarray]:
    poses = []
    for k in range(NODES):
        T = exp(np.array([0.0, 0.0, 4.0 * np.pi * k / NODES]), np.zeros(3))
        poses.append(T @ transform(np.eye(3), [3.0, 0.0, 0.0]))
    return poses


def two_laps(jump: np.ndarray, *, loops: int = 12, false: int = 0):
    """Return a graph whose odometry jumps once, half way, and its loops from the second lap to the first."""
    rng = np.random.default_rng(1)
    truth, graph = circle(), PoseGraph()

    def measured(i: int, j: int, error: np.ndarray) -> np.ndarray:
        noise = exp(rng.normal(0, STEP.rotation_rad, 3), rng.normal(0, STEP.translation_m, 3))
        return inverse(truth[i]) @ truth[j] @ noise @ error

    steps = [
        BetweenFactor(k, k + 1, measured(k, k + 1, jump if k == 20 else np.eye(4)), STEP.information)
        for k in range(NODES - 1)
    ]
    T = np.eye(4)
    graph.add_node(0, 0, T)
    for step in steps:
        T = T @ step.T_i_j
        graph.add_node(step.j, step.j, T)
    aside = transform(np.eye(3), [5.0, 0.0, 0.0])
    closures = [
        loop(
            k,
            k + 20,
            measured(k, k + 20, np.eye(4) if k >= 2 + false else aside),
            information=STEP.information,
        )
        for k in range(2, 2 + loops)
    ]
    graph.add_factors([*steps, *(closure.factor for closure in closures)])
    return graph, closures


def test_loops_that_fit_the_odometry_are_within_a_few_sigma():
    report = solve(*two_laps(np.eye(4)), GraphConfig()).report
    assert report.loop_residual_m < 0.1
    assert report.loop_residual_rad < 0.03
    assert 1.0 < report.loop_residual_sigma < 4.0
    assert report.loops_rejected == 0.0


def test_one_wrong_step_of_the_odometry_shows_in_every_loop():
    jump = exp(np.array([0.0, 0.0, 0.26]), np.array([0.5, 0.0, 0.0]))  # 15 degrees
    report = solve(*two_laps(jump), GraphConfig()).report
    assert report.loop_residual_m > 0.3
    assert report.loop_residual_rad == pytest.approx(0.26, abs=0.03)
    assert report.loop_residual_sigma > 10.0


def test_the_share_of_rejected_loops_is_told():
    solved = solve(*two_laps(np.eye(4), false=3), GraphConfig())
    assert sum(each.verdict == "rejected" for each in solved.loops) == 3
    assert solved.report.loops_rejected == pytest.approx(3 / 12)
    assert solved.report.loop_residual_m < 0.1  # of those that hold


def test_without_loops_nothing_is_told_of_them():
    graph, _ = two_laps(np.eye(4), loops=0)
    report = solve(graph, [], GraphConfig()).report
    assert report.loop_residual_m is report.loop_residual_sigma is report.loops_rejected is None


def test_a_solve_that_changes_nothing_leaves_every_bit():
    graph, _ = two_laps(np.eye(4), loops=0)
    solved = solve(graph, [], GraphConfig()).graph.T_world_node
    assert all(np.array_equal(solved[node], T) for node, T in graph.T_world_node.items())
    bent, closures = two_laps(np.eye(4))
    assert not np.array_equal(
        solve(bent, closures, GraphConfig()).graph.T_world_node[20], graph.T_world_node[20]
    )
