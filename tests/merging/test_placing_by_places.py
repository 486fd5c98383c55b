"""Runs placed by the places that they share, some of which are false."""

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse, length_and_angle
from mapper.loops.config import GateConfig
from mapper.loops.inter_session_loops import SharedPlace
from mapper.merging.multi_session_graph import solve_worlds
from tests.support.loop_closures import loop

GATE = GateConfig()
WORLDS = [
    np.eye(4),
    exp(np.array([0.0, 0.1, 2.0]), np.array([30.0, -4.0, 1.0])),
    exp(np.array([0.1, 0.0, -1.0]), np.array([-8.0, 90.0, 0.0])),
]
"""T_map_world of each run."""


def on_path(along_m):
    return exp(np.array([0.0, 0.0, 0.1 * along_m]), np.array([along_m, 0.2 * along_m, 0.1]))


def measured(first, second, T_first_place, T_first_body, T_second_body):
    """Return a place that two runs share, its keyframe measured at a pose in the first run's world."""
    seen = loop(0, 0, inverse(T_first_place) @ T_first_body, information=np.eye(6))
    return SharedPlace(first, second, T_first_place, T_first_body, T_second_body, seen)


def shared(first, second, along_m, *, rng, noise_m=0.01, T_off=None):
    """Return the places of a path that two runs share, measured with noise and moved by T_off."""
    places = []
    for k in along_m:
        T_map_place, T_map_body = on_path(k), on_path(k + 0.3)
        T_first_place = inverse(WORLDS[first]) @ T_map_place
        noise = exp(rng.normal(0.0, 0.01, 3), rng.normal(0.0, noise_m, 3))
        T_first_body = inverse(WORLDS[first]) @ (np.eye(4) if T_off is None else T_off) @ T_map_body @ noise
        T_second_body = inverse(WORLDS[second]) @ T_map_body
        places.append(measured(first, second, T_first_place, T_first_body, T_second_body))
    return places


def scattered(first, second, count, rng):
    """Return false places, no two of which agree."""
    places = []
    for _ in range(count):
        T_first, T_body, T_second = (
            exp(rng.normal(0.0, 1.0, 3), rng.uniform(-20.0, 20.0, 3)) for _ in range(3)
        )
        places.append(measured(first, second, T_first, T_body, T_second))
    return places


def assert_placed(world, T_map_world, within_m=0.05):
    miss_m, miss_rad = length_and_angle(inverse(world.T_map_world) @ T_map_world)
    assert miss_m < within_m
    assert miss_rad < 0.01


def test_true_places_are_found_among_false_ones():
    rng = np.random.default_rng(0)
    places = [*scattered(0, 1, 20, rng), *shared(0, 1, range(8), rng=rng), *scattered(0, 1, 20, rng)]
    worlds = solve_worlds(places, GATE).worlds
    np.testing.assert_array_equal(worlds[0].T_map_world, np.eye(4))
    assert_placed(worlds[1], WORLDS[1])
    assert worlds[1].places == 8
    assert 0.003 < worlds[1].rms_m < 0.03
    assert set(worlds) == {0, 1}


def test_a_run_is_placed_over_another():
    rng = np.random.default_rng(1)
    places = [*shared(0, 1, range(6), rng=rng), *shared(1, 2, range(20, 26), rng=rng)]
    worlds = solve_worlds(places, GATE).worlds
    assert_placed(worlds[1], WORLDS[1])
    assert_placed(worlds[2], WORLDS[2], within_m=0.2)  # twenty metres along, on angles of six places


@pytest.mark.parametrize("off_m", [0.0, 6.0])
def test_three_runs_are_solved_together_unless_two_contradict_the_others(off_m):
    rng = np.random.default_rng(2)
    T_off = exp(np.array([0.0, 0.0, 0.1 * off_m]), np.array([off_m, 0.0, 0.0]))
    places = [
        *shared(0, 1, range(9), rng=rng),
        *shared(1, 2, range(8), rng=rng),
        *shared(0, 2, range(12, 17), rng=rng, T_off=T_off),
    ]
    solved = solve_worlds(places, GATE)
    worlds = solved.worlds
    assert_placed(worlds[2], WORLDS[2], within_m=0.3)  # its origin is 90 m from the places
    assert [worlds[number].places for number in range(3)] == ([9, 17, 8] if off_m else [14, 17, 13])
    assert solved.contradicting == ([(0, 2)] if off_m else [])
    assert max(world.rms_m for world in worlds.values()) < 0.05


@pytest.mark.parametrize(
    ("along_m", "off_m", "reason"),
    [
        ((0.0, 1.0), (), "2 of 2 places agree, want 3"),
        ((0.0, 0.01, 0.02, 0.03), (), "the 4 places that agree are one place"),
        (
            (0.0, 1.0, 2.0, 3.0),
            (0.5, 1.5, 2.5),
            "4 places agree on one pose and 3 on another: places look alike",
        ),
    ],
)
def test_what_proves_no_pose_ties_no_runs(along_m, off_m, reason):
    rng = np.random.default_rng(3)
    T_off = exp(np.zeros(3), np.array([5.0, 0.0, 0.0]))
    places = [
        *shared(0, 1, along_m, rng=rng, noise_m=0.001),
        *shared(0, 1, off_m, rng=rng, noise_m=0.001, T_off=T_off),
    ]
    solved = solve_worlds(places, GATE)
    assert set(solved.worlds) == {0}
    assert solved.refused[1] == reason


def test_runs_that_are_tied_to_each_other_alone_are_left_out():
    rng = np.random.default_rng(4)
    solved = solve_worlds(
        [*scattered(0, 1, 5, rng), *shared(1, 2, range(6), rng=rng), *scattered(0, 2, 5, rng)], GATE
    )
    assert set(solved.worlds) == {0}
    assert solved.refused[2].startswith("shares places only with runs that")
    assert set(solve_worlds([], GATE).worlds) == {0}


def test_drift_between_distant_places_is_borne():
    rng = np.random.default_rng(5)
    bent = [
        measured(0, 1, on_path(k), exp(np.zeros(3), np.array([0.03 * k, 0.0, 0.0])) @ on_path(k), on_path(k))
        for k in range(0, 40, 4)
    ]
    worlds = solve_worlds([*bent, *scattered(0, 1, 5, rng)], GATE).worlds
    assert worlds[1].places == len(bent)
    assert 0.2 < worlds[1].rms_m < 0.6  # what is left is told
