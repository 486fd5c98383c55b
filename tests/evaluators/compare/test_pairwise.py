"""Pairs of frames, guesses that are off by known amounts, and what counts as right."""

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse, rotation_log
from mapper.core.trajectory import Trajectory
from mapper.evaluators.compare.config import GuessConfig, LidarCompareConfig, RgbdCompareConfig
from mapper.evaluators.compare.pairwise import (
    NO_GUESS,
    Pair,
    guesses_for,
    outcome_of,
    pairs_of,
    registration_records,
)
from mapper.registration.base import Alignment, failed

FRAME_NS = 100_000_000
GUESSES = (
    GuessConfig(offset_m=0.1, turn_rad=np.deg2rad(5.0)),
    GuessConfig(offset_m=3.0, turn_rad=np.deg2rad(180.0)),
)


def straight(n):
    """One metre a frame along x."""
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = np.arange(n)
    return Trajectory(np.arange(n, dtype=np.int64) * FRAME_NS, T)


def test_pairs_are_spread_over_the_log_and_shared_among_distances():
    truth = straight(30)
    pairs = pairs_of(truth.stamps_ns, truth, count=8, frames_apart=(1, 5, 10))

    assert [pair.number for pair in pairs] == list(range(8))
    gaps = [pair.source - pair.target for pair in pairs]
    assert [gaps.count(gap) for gap in (1, 5, 10)] == [3, 3, 2]
    assert [pair.target for pair in pairs if pair.source - pair.target == 5] == [0, 12, 24]
    for pair, gap in zip(pairs, gaps, strict=True):
        np.testing.assert_allclose(pair.T_target_source[:3, 3], [gap, 0.0, 0.0])


def test_distances_longer_than_the_log_leave_their_share_to_others():
    truth = straight(6)
    pairs = pairs_of(truth.stamps_ns, truth, count=6, frames_apart=(1, 5, 10))
    assert [(pair.target, pair.source) for pair in pairs] == [*((k, k + 1) for k in range(5)), (0, 5)]
    assert len(pairs_of(truth.stamps_ns, truth, count=5, frames_apart=(1, 5, 10))) == 5


@pytest.mark.parametrize("frames", [1, 2, 3, 7, 12])
@pytest.mark.parametrize("count", [1, 4, 13, 1000])
def test_as_many_different_pairs_as_there_are_up_to_what_was_asked(frames, count):
    truth, gaps = straight(frames), (10, 3, 1, 3)
    pairs = pairs_of(truth.stamps_ns, truth, count=count, frames_apart=gaps)
    there_are = sum(max(frames - gap, 0) for gap in set(gaps))
    assert len({(pair.target, pair.source) for pair in pairs}) == len(pairs) == min(count, there_are)


def test_frames_that_the_truth_does_not_cover_are_in_no_pair():
    truth = straight(10)
    known = Trajectory(truth.stamps_ns[4:], truth.T_world_body[4:])
    pairs = pairs_of(truth.stamps_ns, known, count=100, frames_apart=(1, 2))
    assert min(pair.target for pair in pairs) == 4
    assert len(pairs) == 5 + 4


@pytest.mark.parametrize("level", [True, False])
def test_guesses_are_off_by_at_most_what_they_say(level):
    T_target_source = exp(np.array([0.3, -0.2, 0.1]), np.array([1.0, 2.0, 3.0]))
    farthest = np.zeros((2, 2))
    for number in range(200):
        pair = Pair(number, 0, 1, T_target_source)
        for kind, T_guess in enumerate(guesses_for(pair, GUESSES, level=level, seed=0)):
            T_off = inverse(T_target_source) @ T_guess
            rotation_rad = rotation_log(T_off[:3, :3])
            off = np.linalg.norm(T_off[:3, 3]), np.rad2deg(np.linalg.norm(rotation_rad))
            farthest[kind] = np.maximum(farthest[kind], off)
            if level:
                np.testing.assert_allclose([T_off[2, 3], *rotation_rad[:2]], 0.0, atol=1e-9)
    limits = np.array([[0.1, 5.0], [3.0, 180.0]])
    assert (farthest <= limits + 1e-9).all()
    assert (farthest >= 0.95 * limits).all()


def test_guesses_depend_on_pair_and_seed_alone():
    pair, other = Pair(3, 0, 1, np.eye(4)), Pair(4, 0, 1, np.eye(4))
    first = guesses_for(pair, GUESSES, level=False, seed=7)
    np.testing.assert_array_equal(first, guesses_for(pair, GUESSES, level=False, seed=7))
    np.testing.assert_array_equal(first[0], guesses_for(pair, GUESSES[:1], level=False, seed=7)[0])
    assert not np.allclose(first[0], guesses_for(other, GUESSES, level=False, seed=7)[0])
    assert not np.allclose(first[0], guesses_for(pair, GUESSES, level=False, seed=8)[0])


@pytest.mark.parametrize(
    ("offset_m", "turn_deg", "settings", "outcome"),
    [
        (0.049, 1.9, {}, "right"),
        (0.051, 0.0, {}, "wrong"),
        (0.0, 2.1, {}, "wrong"),
        (0.0, 2.1, {"max_error_rad": 0.04}, "right"),
    ],
)
def test_an_answer_is_right_if_neither_error_is_too_large(offset_m, turn_deg, settings, outcome):
    T_true = exp(np.array([0.1, 0.2, 0.3]), np.array([1.0, 0.0, 0.0]))
    off = exp(np.array([0.0, 0.0, np.deg2rad(turn_deg)]), np.zeros(3))
    off[0, 3] = offset_m
    alignment = Alignment(T_true @ off, converged=True, inlier_ratio=1.0, inlier_rmse_m=0.0)
    found = outcome_of(alignment, T_true, RgbdCompareConfig(**settings))
    assert found["outcome"] == outcome
    errors = found["translation_m"], np.rad2deg(found["rotation_rad"])
    assert errors == pytest.approx((offset_m, turn_deg), abs=1e-9)


def test_no_answer_is_neither_right_nor_wrong():
    found = outcome_of(failed("no idea"), np.eye(4), LidarCompareConfig())
    assert found == {"outcome": "none", "translation_m": None, "rotation_rad": None}


def trial(method, guess, outcome, error=None):
    return {
        "method": method,
        "guess": guess,
        "outcome": outcome,
        "translation_m": error,
        "rotation_rad": error and error / 10,
        "prepare_ms": 2.0,
        "align_ms": 30.0 if error is not None and error < 1 else 90.0,
    }


def test_medians_are_of_the_right_ones_and_failures_are_counted():
    trials = [
        trial("b", "0.1 m", "right", 0.01),
        trial("a", NO_GUESS, "none"),
        trial("b", "0.1 m", "wrong", 5.0),
        trial("b", "1 m", "wrong", 7.0),
        trial("b", "0.1 m", "right", 0.03),
        trial("b", "0.1 m", "none"),
    ]
    near, far, blind = registration_records(trials)

    assert (near["method"], near["guess_off_by"], near["trials"]) == ("b", "0.1 m", 4)
    assert (near["right"], near["wrong"], near["no_answer"]) == (2, 1, 1)
    assert (near["median_m"], near["p95_m"]) == pytest.approx((0.02, 0.029))
    assert (near["median_rad"], near["p95_rad"]) == pytest.approx((0.002, 0.0029))
    assert (near["prepare_ms"], near["align_ms"]) == (2.0, 60.0)
    assert (far["right"], far["wrong"], far["median_m"]) == (0, 1, None)
    assert (blind["method"], blind["guess_off_by"], blind["no_answer"]) == ("a", NO_GUESS, 1)
    assert blind["median_rad"] is None
