"""Runs joined to one pose graph: they bend where the others show drift, and false loops are rejected."""

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse
from mapper.graph.config import GraphConfig
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.loops.inter_session_loops import shared_place
from mapper.merging.multi_session_graph import solve_jointly
from tests.support.loop_closures import loop

CONFIG = GraphConfig()
NODES = 21
T_A_B = exp(np.array([0.0, 0.0, 1.0]), np.array([40.0, -7.0, 1.0]))
"""World of the second run in that of the first."""
SURE, UNSURE = PoseSigmas(0.002, 0.005).information, PoseSigmas(0.02, 0.05).information


def on_path(k):
    return exp(np.array([0.0, 0.0, 0.05 * k]), np.array([k, 0.1 * k, 0.0]))


def drive(*, drift=0.0, T_world_first=None, first_node=0):
    """Return the graph of a drive whose odometry measures every step longer by a share, at its own poses."""
    T_world_node = [np.eye(4) if T_world_first is None else T_world_first]
    graph = PoseGraph()
    for k in range(NODES):
        graph.add_node(first_node + k, 1000 * k, T_world_node[-1])
        T_i_j = inverse(on_path(k)) @ on_path(k + 1)
        T_i_j[:3, 3] *= 1.0 + drift
        T_world_node.append(T_world_node[-1] @ T_i_j)
        if k:
            T_before = inverse(T_world_node[k - 1]) @ T_world_node[k]
            graph.add_factors(
                [BetweenFactor(first_node + k - 1, first_node + k, T_before, UNSURE if drift else SURE)]
            )
    return graph


def seen_again(graphs, first, second, nodes, *, T_off=None):
    """Return places of one run at which another run is seen where it truly is, moved by T_off."""
    places = []
    for k in nodes:
        i, j = (list(graphs[number].T_world_node)[k] for number in (first, second))
        seen = loop(i, j, T_off, information=SURE)
        places.append(shared_place(first, second, seen, *(graphs[n].T_world_node for n in (first, second))))
    return places


@pytest.fixture(scope="module")
def graphs():
    """A true drive, one that measured every step 3 % too long, and one that nothing ties to them."""
    return {
        0: drive(),
        1: drive(drift=0.03, T_world_first=inverse(T_A_B), first_node=5),
        2: drive(T_world_first=exp(np.zeros(3), np.array([0.0, 500.0, 0.0]))),
    }


def poses(graphs, *numbers):
    worlds = {0: np.eye(4), 1: T_A_B, 2: exp(np.zeros(3), np.array([0.0, -500.0, 0.0]))}
    return {number: graphs[number] for number in numbers}, {number: worlds[number] for number in numbers}


def miss_m(joint, number):
    found = np.array([T[:3, 3] for T in joint.poses_of(number).values()])
    return np.linalg.norm(found - [on_path(k)[:3, 3] for k in range(NODES)], axis=1)


def test_a_run_that_drifted_bends_to_where_the_others_saw_it(graphs):
    places = seen_again(graphs, 0, 1, range(0, NODES, 2))
    joint = solve_jointly(*poses(graphs, 0, 1), places, [], CONFIG)
    rigid = T_A_B @ graphs[1].T_world_node[25]
    assert np.linalg.norm(rigid[:3, 3] - on_path(20)[:3, 3]) > 0.5
    assert miss_m(joint, 1).max() < 0.03
    assert miss_m(joint, 0).max() < 0.03
    np.testing.assert_allclose(joint.graph.T_world_node[0], np.eye(4), atol=1e-9)
    assert list(joint.poses_of(1)) == list(graphs[1].T_world_node)
    (tie,) = joint.ties
    assert (tie.first, tie.second, tie.measured, tie.held) == (0, 1, 11, 11)
    assert tie.rms_m < 0.02


def test_false_loops_are_rejected_and_say_why(graphs):
    T_off = exp(np.array([0.0, 0.0, 0.5]), np.array([6.0, 0.0, 0.0]))
    true, false = (
        seen_again(graphs, 0, 1, range(0, NODES, 2)),
        seen_again(graphs, 0, 1, range(1, 6, 2), T_off=T_off),
    )
    other = seen_again(graphs, 0, 1, [19], T_off=T_off)
    joint = solve_jointly(*poses(graphs, 0, 1), [*true, *false], other, CONFIG)
    assert [each.verdict for each in joint.loops] == ["accepted"] * 11 + ["rejected"] * 4
    assert all(each.reason.startswith("solver: ") for each in joint.loops[11:14])
    assert joint.loops[14].reason.startswith("consensus: ")
    assert miss_m(joint, 1).max() < 0.03
    assert sum(factor.origin == "loop" for factor in joint.graph.factors) == 11


def test_a_run_of_which_no_loop_holds_is_left_out(graphs):
    wrong = [
        place
        for k in range(0, NODES, 4)
        for place in seen_again(
            graphs, 1, 2, [k], T_off=exp(np.array([0.0, 0.0, 0.4 * k]), np.array([7.0 * k, 0.0, 0.0]))
        )
    ]
    true = seen_again(graphs, 0, 1, range(0, NODES, 2))
    third = seen_again(graphs, 0, 2, range(0, NODES, 2))
    held = solve_jointly(*poses(graphs, 0, 1, 2), [*true, *third, *wrong], [], CONFIG)
    assert list(held.first_nodes) == [0, 1, 2]
    assert [(tie.first, tie.second, tie.held) for tie in held.ties] == [(0, 1, 11), (0, 2, 11), (1, 2, 1)]
    assert held.run_of(max(held.graph.T_world_node)) == 2

    alone = solve_jointly(*poses(graphs, 0, 1, 2), true, [], CONFIG)
    assert list(alone.first_nodes) == [0, 1]
    assert len(alone.graph.T_world_node) == 2 * NODES
    assert {factor.j in alone.graph.T_world_node for factor in alone.graph.factors} == {True}
