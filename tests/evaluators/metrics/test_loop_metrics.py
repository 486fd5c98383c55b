"""Precision and recall of loop closures against the truth."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse, log
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.loops import (
    agreement_of_loops,
    loop_metrics,
    loop_metrics_of_run,
    revisits_of,
)
from mapper.graph.config import GraphConfig
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.graph.optimize import optimize
from mapper.loops.closure import LoopClosure
from mapper.loops.config import PlaceLoopsConfig, ScanLoopsConfig
from tests.support.loop_closures import loop
from tests.support.planar import at


@pytest.fixture
def truth() -> Trajectory:
    """Ten seconds out along x at 0.5 m/s and ten seconds back, a pose a second."""
    x = [0.5 * (k if k <= 10 else 20 - k) for k in range(21)]
    stamps_ns = np.arange(21) * NS_PER_S
    return Trajectory(stamps_ns, np.array([at(value) for value in x]))


def closure(i: int, j: int, x: float, verdict: str = "accepted") -> LoopClosure:
    reason = "" if verdict == "accepted" else "isvd: no"
    found = loop(i, j, at(x), verdict=verdict, reason=reason, information=np.eye(6))
    return replace(found, stamp_i_ns=i * NS_PER_S, stamp_j_ns=j * NS_PER_S)


def values(metrics) -> dict[str, float]:
    return {metric.name: metric.value for metric in metrics}


def test_revisits_are_near_alike_and_long_ago(truth):
    revisit = revisits_of(truth.stamps_ns, truth)
    assert revisit.nonzero()[0].tolist() == list(range(12, 21))  # at 12 s as at 7 s, half a metre away
    T = truth.T_world_body.copy()
    T[11:, :3, :3] = at(0.0, yaw=np.pi)[:3, :3]  # looking the other way
    assert not revisits_of(truth.stamps_ns, Trajectory(truth.stamps_ns, T)).any()
    assert not revisits_of(truth.stamps_ns + 1000 * NS_PER_S, truth).any()  # the truth does not cover it


@pytest.mark.parametrize(
    ("loops", "wrong", "found", "count"),
    [
        ([(2, 18, 0.05), (3, 17, 0.5)], 1, 2, 2),
        ([(2, 18, 0.0), (1, 18, 0.5)], 0, 1, 2),  # of one revisit
        ([(3, 17, 0.5, "rejected")], 0, 0, 0),
    ],
)
def test_accepted_loops_are_right_or_wrong_by_the_truth(truth, loops, wrong, found, count):
    told = values(loop_metrics([closure(*each) for each in loops], truth.stamps_ns, truth))
    assert told["loops"] == count
    assert told["loops wrongly accepted"] == wrong
    assert (told["true revisits with a loop"], told["true revisits"]) == (found, 9)


def test_without_revisits_there_are_none(truth):
    assert set(values(loop_metrics([], truth.stamps_ns[:10], truth)).values()) == {0}


def test_where_looks_are_rare_a_loop_counts_for_the_keyframes_around(truth):
    told = values(loop_metrics([closure(2, 18, 0.0)], truth.stamps_ns, truth, searched_every_m=1.0))
    assert told["true revisits with a loop"] == 5  # 16 to 20 s, half a metre apart


@pytest.mark.parametrize(
    ("loops", "found"), [(ScanLoopsConfig(min_motion_m=1.0), 5), (PlaceLoopsConfig(min_motion_m=1.0), 1)]
)
def test_scans_are_searched_for_loops_once_in_some_metres(truth, loops, found):
    run = SimpleNamespace(config=SimpleNamespace(loops=loops), loops=[closure(2, 18, 0.0)], keyframes=truth)
    assert values(loop_metrics_of_run(run, truth))["true revisits with a loop"] == found


def ring(*, false_m=0.0, seed=0):
    """Return a solved ring of 40 nodes walked twice, with ten loops, the last of which errs by a distance."""
    rng = np.random.default_rng(seed)
    sigmas = PoseSigmas(rotation_rad=0.002, translation_m=0.005)
    noise = np.repeat([sigmas.rotation_rad, sigmas.translation_m], 3)
    turn = exp(np.array([0.0, 0.0, 2.0 * np.pi / 40.0]), np.array([0.3, 0.0, 0.0]))
    true = [np.linalg.matrix_power(turn, k) for k in range(80)]

    def measured(i, j, origin, off_m=0.0):
        error = rng.normal(0.0, noise)
        T = inverse(true[i]) @ true[j] @ exp(error[:3], error[3:] + off_m * np.eye(3)[0])
        return BetweenFactor(i, j, T, sigmas.information, origin)

    factors = [measured(k - 1, k, "odometry") for k in range(1, 80)]
    loops = [measured(k, k + 40, "loop", false_m * (k == 36)) for k in range(0, 40, 4)]
    graph = PoseGraph(dict(enumerate(true)), {k: k * NS_PER_S for k in range(80)}, [*factors, *loops])
    return solved(graph)


def solved(graph):
    return graph.with_poses(optimize(graph, GraphConfig(robust="none")).T_world_node)


def test_a_loop_is_as_far_from_the_others_as_a_solve_without_it_says():
    graph = ring()
    distances_m = []
    for left_out in graph.loops:
        without = solved(graph.with_factors(factor for factor in graph.factors if factor is not left_out))
        T_i_j = inverse(without.T_world_node[left_out.i]) @ without.T_world_node[left_out.j]
        distances_m.append(np.linalg.norm(log(inverse(T_i_j) @ left_out.T_i_j)[1]))
    told = values(agreement_of_loops(graph))
    assert told["loops compared with all others"] == 10
    assert told["loops off the others, median"] == pytest.approx(np.median(distances_m), rel=0.03)
    assert told["loops off the others, largest"] == pytest.approx(max(distances_m), rel=0.03)
    assert told["loops that contradict the others"] == 0


def test_loops_agree_alike_at_poses_that_something_else_moved():
    graph, rng = ring(), np.random.default_rng(1)
    moved = {node: T @ exp(*rng.normal(0.0, 0.003, (2, 3))) for node, T in graph.T_world_node.items()}
    told, expected = (values(agreement_of_loops(one)) for one in (graph.with_poses(moved), graph))
    assert told == pytest.approx(expected, rel=1e-3)


def test_a_false_loop_contradicts_the_others():
    told = values(agreement_of_loops(ring(false_m=0.2)))
    assert told["loops that contradict the others"] >= 1
    assert told["loops off the others, largest"] == pytest.approx(0.2, rel=0.2)


def test_what_nothing_else_ties_is_not_compared():
    graph = ring()
    chain = graph.with_factors([*graph.without_loops().factors[:-1], graph.loops[0]])
    assert agreement_of_loops(chain.without_loops()) == []
    assert values(agreement_of_loops(chain))["loops compared with all others"] == 1
