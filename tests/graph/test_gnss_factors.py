"""Measured positions in a graph: they place it, hold it, and make its nodes more certain."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import GraphError
from mapper.core.geometry import exp, transform
from mapper.graph.config import GraphConfig
from mapper.graph.gnss_factors import TooShortError, align, check, correct
from mapper.graph.marginals import marginals_of
from mapper.graph.model import PoseGraph, PoseSigmas, PositionFactor
from mapper.graph.optimize import optimize
from tests.support.noisy_graphs import noisy_measure, odometry_chain

SIGMAS = PoseSigmas(rotation_rad=2e-3, translation_m=0.02)
ARM = np.array([0.5, -0.2, 1.0])


def bend(count: int = 60) -> list[np.ndarray]:
    """A quarter of a circle, level."""
    poses = [transform(np.eye(3), np.array([5.0, 2.0, 1.0]))]
    for _ in range(count - 1):
        poses.append(poses[-1] @ exp(np.array([0.0, 0.0, 0.026]), np.array([2.0, 0.0, 0.0])))
    return poses


def measured(truth, sigma_m: float = 0.1, seed: int = 1) -> list[PositionFactor]:
    rng = np.random.default_rng(seed)
    return [
        PositionFactor(
            node, ARM, T[:3, :3] @ ARM + T[:3, 3] + rng.normal(0.0, sigma_m, 3), np.eye(3) / sigma_m**2
        )
        for node, T in enumerate(truth)
    ]


def graph_of(truth, seed: int = 2) -> PoseGraph:
    return odometry_chain(truth, noisy_measure(truth, np.random.default_rng(seed)), SIGMAS)


def test_a_path_is_aligned_by_heading_and_place_whatever_a_few_fixes_say():
    truth = bend()
    T_enu_world = exp(np.array([0.0, 0.0, 2.5]), np.array([300.0, -150.0, 20.0]))
    fixes = [fix.moved(T_enu_world) for fix in measured(truth)]
    fixes[10:22] = [
        replace(fix, position_world=fix.position_world + np.array([8.0, 6.0, 2.0])) for fix in fixes[10:22]
    ]
    found = align(fixes, dict(enumerate(truth)))
    np.testing.assert_allclose(found.T_enu_world[:3, :3], T_enu_world[:3, :3], atol=0.01)
    at_end = found.T_enu_world @ truth[-1]
    np.testing.assert_allclose(at_end[:3, 3], (T_enu_world @ truth[-1])[:3, 3], atol=0.3)
    assert np.flatnonzero(found.residuals_m > 5.0).tolist() == list(range(10, 22))
    assert found.heading_sigma_rad < 0.01
    check(found, 120.0)


def test_a_moved_measurement_has_the_same_residual():
    fix = replace(measured(bend())[7], information=np.diag([1.0, 4.0, 9.0]))
    T = exp(np.array([0.1, 0.2, 1.5]), np.array([3.0, 4.0, 5.0]))
    moved, off = fix.moved(T), np.array([0.3, -0.1, 0.2])
    turned = T[:3, :3] @ off
    assert turned @ moved.information @ turned == pytest.approx(off @ fix.information @ off)
    np.testing.assert_allclose(moved.position_world, T[:3, :3] @ fix.position_world + T[:3, 3])


def test_fixes_place_the_graph_and_outliers_are_named():
    truth = bend()
    fixes = measured(truth)
    fixes[30:38] = [
        replace(fix, position_world=fix.position_world + np.array([4.0, 3.0, 0.0])) for fix in fixes[30:38]
    ]
    corrected, holds = correct(graph_of(truth), fixes, GraphConfig())
    assert np.flatnonzero(~holds).tolist() == list(range(30, 38))
    assert len(corrected.fixes) == 52
    off_m = np.linalg.norm(corrected.positions - np.array(truth)[:, :3, 3], axis=1)
    assert off_m.max() < 0.25


def test_fixes_of_which_most_disagree_are_refused():
    truth = bend()
    rng = np.random.default_rng(4)
    wild = [replace(fix, position_world=fix.position_world + rng.normal(0, 40, 3)) for fix in measured(truth)]
    with pytest.raises(GraphError, match="contradict"):
        correct(graph_of(truth), wild, GraphConfig())
    with pytest.raises(TooShortError):
        check(align(measured(truth, sigma_m=30.0), dict(enumerate(truth))), 120.0)


def test_a_graph_with_fixes_is_solved_where_these_are_whatever_it_starts_from():
    truth = bend()
    graph = replace(graph_of(truth), fixes=tuple(measured(truth)))
    shift = exp(np.array([0.0, 0.0, 0.4]), np.array([20.0, 5.0, 3.0]))
    away = graph.with_poses({node: shift @ T for node, T in graph.T_world_node.items()})
    solution = optimize(away, GraphConfig())
    found = np.array(list(solution.T_world_node.values()))[:, :3, 3]
    np.testing.assert_allclose(found, np.array(truth)[:, :3, 3], atol=0.25)
    without = optimize(replace(away, fixes=()), GraphConfig())
    np.testing.assert_allclose(without.T_world_node[0], away.T_world_node[0], atol=1e-6)


def test_fixes_make_far_nodes_more_certain_and_parts_keep_their_own():
    truth = bend()
    graph = graph_of(truth)
    held = replace(graph, fixes=tuple(measured(truth)))
    plain, certain = (marginals_of(g).nodes[59][3:, 3:].trace() ** 0.5 for g in (graph, held))
    assert certain < 0.5 * plain
    assert [fix.node for fix in held.part(range(5)).fixes] == [0, 1, 2, 3, 4]
    T = exp(np.array([0.0, 0.0, 1.0]), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(held.moved(T).fixes[3].position_world, held.fixes[3].moved(T).position_world)
