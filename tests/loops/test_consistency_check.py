"""Consistency check: a loop counts once a loop from another keyframe nearby agrees."""

import numpy as np
import pytest

from mapper.graph.model import BetweenFactor
from mapper.loops.config import GateConfig
from mapper.loops.consistency_check import ConsistencyCheck
from mapper.loops.odometry_drift import OdometryChain
from tests.support.loop_closures import SURE, loop
from tests.support.planar import at


class FixedPoses:
    """An estimator whose poses no loop changes."""

    def __init__(self, poses: dict[int, np.ndarray]) -> None:
        self._poses = poses

    def pose_of(self, node: int) -> np.ndarray:
        return self._poses[node]


@pytest.fixture
def check():
    """Nodes 0 … 40 on a line, a metre apart; one other must agree."""
    chain = OdometryChain()
    chain.add([BetweenFactor(k, k + 1, at(1.0), SURE) for k in range(40)])
    estimator = FixedPoses({k: at(float(k)) for k in range(41)})
    return ConsistencyCheck(chain, estimator, GateConfig(), min_agreeing=1, within_m=3.0)


def test_a_lone_loop_waits_until_another_agrees(check):
    first, second = loop(2, 30, at(0.5)), loop(3, 31, at(0.5))
    assert check.add(first) == []
    assert check.add(second) == [first, second]


def test_a_loop_that_disagrees_is_no_support(check):
    assert check.add(loop(2, 30, at(0.5))) == []
    assert check.add(loop(3, 31, at(2.5))) == []


def test_another_loop_of_the_same_keyframe_is_no_support(check):
    assert check.add(loop(2, 30, at(0.5))) == []
    assert check.add(loop(3, 30, at(-0.5))) == []


def test_a_loop_far_along_the_path_is_no_support(check):
    assert check.add(loop(2, 30, at(0.5))) == []
    assert check.add(loop(12, 40, at(0.5))) == []


def test_a_third_loop_joins_those_confirmed(check):
    check.add(loop(2, 30, at(0.5)))
    check.add(loop(3, 31, at(0.5)))
    third = loop(4, 32, at(0.5))
    assert check.add(third) == [third]
