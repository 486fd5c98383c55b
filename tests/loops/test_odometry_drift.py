"""Paths along odometry and loops, and the drift that a gate allows over them."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mapper.graph.model import BetweenFactor
from mapper.loops.closure import Discrepancy, exceeds
from mapper.loops.config import GateConfig
from mapper.loops.odometry_drift import OdometryChain, allowed
from tests.support.loop_closures import SURE
from tests.support.planar import at


def steps(length: int) -> list[BetweenFactor]:
    return [BetweenFactor(k, k + 1, at(1.0, 0.0, 0.1), SURE) for k in range(length)]


def test_the_path_between_two_nodes_is_as_long_as_its_steps():
    chain = OdometryChain()
    chain.add(steps(10))
    path = chain.between(2, 9).path
    assert path.path_m == pytest.approx(7.0)
    assert path.turned_rad == pytest.approx(0.7)
    assert chain.between(9, 2).path == path


def test_a_loop_shortens_every_path_over_it():
    chain = OdometryChain()
    chain.add(steps(10))
    chain.add([BetweenFactor(0, 10, at(0.1), SURE, "loop")])
    assert chain.between(1, 9).path.path_m == pytest.approx(2.1)


def test_disconnected_nodes_have_no_path():
    chain = OdometryChain()
    chain.add(steps(3))
    chain.add([BetweenFactor(20, 21, at(1.0), SURE)])
    assert chain.between(0, 21) is None


def test_connected_nodes_are_those_with_a_path():
    chain = OdometryChain()
    assert chain.connected(3, [3, 4]).tolist() == [True, False]
    chain.add(steps(3))
    chain.add([BetweenFactor(20, 21, at(1.0), SURE)])
    assert chain.connected(0, [3, 20, 21, 40]).tolist() == [True, False, False, False]
    assert chain.connected(40, []).tolist() == []
    chain.add([BetweenFactor(21, 2, at(1.0), SURE, "loop")])
    assert chain.connected(0, [3, 20, 21, 40]).tolist() == [True, True, True, False]


@pytest.mark.parametrize("edges", [100, 1500, 4000])
def test_parts_may_grow_together_in_any_order(edges):
    rng = np.random.default_rng(edges)
    ends = np.array([rng.choice(3000, 2, replace=False) for _ in range(edges)])
    chain = OdometryChain()
    for i, j in ends.tolist():
        chain.add([BetweenFactor(i, j, at(1.0), SURE)])
    _, labels = connected_components(coo_array((np.ones(edges), tuple(ends.T)), shape=(3000, 3000)))
    for node in rng.integers(0, 3000, 20).tolist():
        assert chain.connected(node, range(3000)).tolist() == (labels == labels[node]).tolist()


def test_around_a_node_lie_those_within_reach():
    chain = OdometryChain()
    chain.add(steps(10))
    assert sorted(chain.around(5, within_m=2.0)) == [3, 4, 5, 6, 7]


def test_the_gate_widens_with_the_path():
    chain = OdometryChain()
    chain.add(steps(40))
    gate = GateConfig()
    near, far = (allowed(gate, chain.between(0, node).path) for node in (1, 40))
    assert far.translation_m == pytest.approx(gate.slack_m + gate.drift_ratio * 40.0)
    assert far.rotation_rad > near.rotation_rad
    assert exceeds(Discrepancy(1.0, 0.0), near)
    assert not exceeds(Discrepancy(1.0, 0.0), far)
    assert exceeds(Discrepancy(0.0, 3.0), far)
