"""Keyframes along a corridor, 0.4 m apart, that see the floor; the odometry turns and falls a little."""

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse, rotation_exp, transform
from mapper.graph.config import GraphConfig
from mapper.graph.floor_factors import floor_factors, on_one_floor, with_height_and_tilt
from mapper.graph.model import PoseSigmas
from mapper.graph.optimize import optimize
from tests.support.noisy_graphs import drifted_chain

COUNT = 40
SIGMAS = PoseSigmas(rotation_rad=0.006, translation_m=0.01)
DRIFT = exp(np.radians([0.15, 0.1, 0.05]), np.array([0.0, 0.0, -0.002]))


def nowhere(_x):
    return 0.0


def walk(height_m=nowhere, tilt_rad=nowhere, drift=DRIFT):
    """The true poses, a graph that has drifted, and the floor that each node sees; it rises along x."""
    truth, floors = [], {}
    for k in range(COUNT):
        x = 0.4 * k
        R = rotation_exp(np.array([0.0, 0.0, 0.2 * np.sin(k)])) @ rotation_exp(np.array([0.0, 0.2, 0.0]))
        truth.append(transform(R, np.array([x, 0.0, 1.4 + height_m(x)])))
        seen = transform(rotation_exp(np.array([0.0, -tilt_rad(x), 0.0])), np.array([x, 0.0, height_m(x)]))
        floors[k] = inverse(truth[k]) @ seen
    return truth, drifted_chain(truth, drift, SIGMAS), floors


def held(graph, floors, nodes):
    for _ in range(3):
        factors = floor_factors(graph.T_world_node, floors, nodes)
        there = graph.with_factors([*graph.factors[: COUNT - 1], *factors])
        graph = graph.with_poses(optimize(there, GraphConfig()).T_world_node)
    return graph


def errors(truth, T_world_node):
    """Height (m) and tilt (degrees) at the worst node, seen from the first."""
    T_truth_world = truth[0] @ inverse(T_world_node[0])
    off = [inverse(T) @ T_truth_world @ T_world_node[k] for k, T in enumerate(truth)]
    height_m = [abs((T_truth_world @ T_world_node[k])[2, 3] - T[2, 3]) for k, T in enumerate(truth)]
    return max(height_m), max(np.degrees(np.arccos(np.clip(T[2, 2], -1, 1))) for T in off)


def test_one_floor_takes_height_and_tilt_from_a_drifted_path():
    truth, graph, floors = walk()
    nodes = on_one_floor(graph, floors)
    assert nodes == list(range(COUNT))
    after = held(graph, floors, nodes)
    combined = with_height_and_tilt(graph.T_world_node, after.T_world_node, floors, nodes)
    height_m, tilt_deg = errors(truth, graph.T_world_node)
    assert height_m > 0.3
    assert tilt_deg > 4.0
    height_m, tilt_deg = errors(truth, combined)
    assert height_m < 0.1
    assert tilt_deg < 1.5
    assert np.allclose(combined[0], graph.T_world_node[0])


def test_place_and_heading_stay_those_of_the_odometry():
    _, graph, floors = walk(drift=np.eye(4))
    bent = {k: T @ exp(np.array([0.0, 0.0, 0.001 * k]), np.zeros(3)) for k, T in graph.T_world_node.items()}
    combined = with_height_and_tilt(graph.T_world_node, bent, floors, list(range(COUNT)))
    for k, T in graph.T_world_node.items():
        assert combined[k][:2, 3] == pytest.approx(T[:2, 3], abs=1e-3)
        assert combined[k][:2, 0] == pytest.approx(T[:2, 0], abs=0.02)


def test_a_node_that_sees_a_table_is_left_out():
    _, graph, floors = walk()
    floors[20] = floors[20] @ transform(np.eye(3), np.array([0.0, 0.0, 0.75]))
    assert on_one_floor(graph, floors) == [k for k in range(COUNT) if k != 20]


@pytest.mark.parametrize(
    ("height_m", "tilt_rad"),
    [
        (lambda x: 0.1 * max(x - 6.0, 0.0), lambda x: 0.1 * (x > 6.0)),
        (lambda x: 0.17 * max(np.floor((x - 4.0) / 0.28), 0.0), nowhere),
        (lambda x: 3.0 * (x > 8.2), nowhere),
    ],
    ids=["ramp", "stairs", "two storeys"],
)
def test_nodes_above_another_floor_are_never_put_on_the_first(height_m, tilt_rad):
    _, graph, floors = walk(height_m, tilt_rad)
    heights = {height_m(0.4 * k) for k in on_one_floor(graph, floors)}
    assert max(heights, default=0.0) - min(heights, default=0.0) < 0.05


def test_a_gentle_ramp_is_not_flattened():
    """Neighbours on a ramp of 4 degrees see what may be the same plane; those farther apart do not."""
    slope = np.tan(np.radians(4.0))
    _, graph, floors = walk(
        lambda x: slope * float(np.clip(x - 5.0, 0.0, 4.0)),
        lambda x: slope * float(np.clip((x - 4.0) / 2.0, 0.0, 1.0)),
    )
    assert on_one_floor(graph, floors) == []


def test_few_nodes_show_no_floor():
    _, graph, floors = walk()
    assert on_one_floor(graph, {k: floors[k] for k in range(5)}) == []
    assert on_one_floor(graph, {}) == []
