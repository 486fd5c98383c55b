"""Wheel factors: their order and noise, motions that wheels rule out, wheels that slip."""

import re
from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import inverse, transform
from mapper.core.timebase import NS_PER_S as S
from mapper.graph.config import WheelFactorsConfig
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.graph.wheel_factors import WheelMeasurements, wheel_conflict
from tests.support.planar import arc, at


def wheel_factors(stamps_ns, wheels, config):
    """The factors of nodes that come in time order."""
    measurements = WheelMeasurements(wheels, config)
    return [factor for node, stamp_ns in stamps_ns.items() for factor in measurements.link(node, stamp_ns)]


def test_factors_follow_time_and_are_less_certain_the_longer_the_path():
    wheels = arc(11, turn_rad=0.1)
    stamps_ns = {7: 0, 3: S // 10, 5: S, 9: 2 * S}  # node 9 comes after the wheels stopped
    config = WheelFactorsConfig()
    near, far = wheel_factors(stamps_ns, wheels, config)
    assert [(f.i, f.j, f.origin) for f in (near, far)] == [(7, 3, "wheel"), (3, 5, "wheel")]
    np.testing.assert_allclose(near.T_i_j, at(0.5, 0.0, 0.1), atol=1e-12)
    np.testing.assert_allclose(
        far.T_i_j, inverse(wheels.T_world_body[1]) @ wheels.T_world_body[10], atol=1e-12
    )
    sigma_rad, sigma_m = far.information[0, 0] ** -0.5, far.information[5, 5] ** -0.5
    assert sigma_m == pytest.approx(config.least_m + config.path_share * 4.5)
    assert sigma_rad == pytest.approx(config.least_rad + config.turn_share * 0.9 + config.rad_per_m * 4.5)
    assert near.information[5, 5] > far.information[5, 5]


def test_there_and_back_is_a_long_path():
    wheels = arc(11)
    there_and_back = replace(wheels, T_world_body=wheels.T_world_body[[*range(6), 4, 3, 2, 1, 0]])
    (factor,) = wheel_factors({0: 0, 1: S}, there_and_back, WheelFactorsConfig())
    np.testing.assert_allclose(factor.T_i_j, np.eye(4), atol=1e-12)
    assert factor.information[5, 5] ** -0.5 == pytest.approx(0.01 + 0.05 * 5.0)


def test_a_motion_that_the_wheels_did_not_make_is_named():
    wheels = WheelMeasurements(arc(21), WheelFactorsConfig())
    driven = transform(np.eye(3), [10.0, 0.0, 0.0])
    assert wheels.contradiction(driven, 0, 2 * S) == ""
    assert wheels.contradiction(transform(np.eye(3), [9.0, 0.5, 0.0]), 0, 2 * S) == ""  # 5 % of the way
    assert wheels.contradiction(np.eye(4), 0, 2 * S).startswith("10.00 m and 0.00 rad off, at most 2.")
    assert wheels.contradiction(np.eye(4), 0, 9 * S) == ""  # no readings, so nothing is known
    assert WheelMeasurements(None, WheelFactorsConfig()).contradiction(np.eye(4), 0, 2 * S) == ""


def test_wheels_that_slip_are_told():
    stamps_ns = {k: k * S // 2 for k in range(5)}
    graph = PoseGraph()
    for k, stamp_ns in stamps_ns.items():  # the third step has two metres, of which the wheels know nothing
        graph.add_node(k, stamp_ns, at(2.5 * k + (2.0 if k > 2 else 0.0), 0.0, 0.0))
    steps = [BetweenFactor(k, k + 1, np.eye(4), np.eye(6)) for k in range(4)]
    driven = wheel_factors(stamps_ns, arc(21), WheelFactorsConfig())
    connected, broken = (PoseGraph(graph.T_world_node, stamps_ns, kept) for kept in (steps, steps[:2]))
    said = wheel_conflict(connected, driven)
    assert said.startswith("the wheels contradict the odometry in 1 of 4 steps between keyframes, by 2.00 m")
    assert wheel_conflict(broken, driven) == ""  # the odometry measured nothing there
    assert wheel_conflict(connected, []) == ""


@pytest.mark.parametrize("times", [0.3048, 5.0])
def test_lengths_of_another_unit_are_named(times):
    stamps_ns = {k: k * S // 2 for k in range(5)}
    graph = PoseGraph()
    for k, stamp_ns in stamps_ns.items():
        graph.add_node(k, stamp_ns, at(2.5 * k / times, 0.0, 0.0))
    graph.add_factors(BetweenFactor(k, k + 1, np.eye(4), np.eye(6)) for k in range(4))
    said = wheel_conflict(graph, wheel_factors(stamps_ns, arc(21), WheelFactorsConfig()))
    assert float(re.search(r"are ([\d.]+) times", said)[1]) == pytest.approx(times, rel=0.02)


def test_without_wheels_or_when_switched_off_there_are_no_factors():
    stamps_ns = {0: 0, 1: S // 10}
    assert wheel_factors(stamps_ns, None, WheelFactorsConfig()) == []
    assert wheel_factors(stamps_ns, arc(3), WheelFactorsConfig(use=False)) == []
    assert wheel_factors({0: 5 * S}, arc(3), WheelFactorsConfig()) == []
