"""Motions that no surface showed, estimated from the velocities before and after."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.doubts import Doubt
from mapper.core.geometry import inverse, rotation_exp, transform
from mapper.graph.model import BetweenFactor
from mapper.odometry.base import Diagnostics, FrameResult, UnseenMotions, lost_frame
from mapper.odometry.scan_to_map.unseen_motion_smoothing import smooth_unseen_motions

FRAMES, INTERVAL_S = 120, 0.1
ALONG = np.eye(6)[3:4]
SIGMA_M = 0.01
COVARIANCE = np.diag([1e-6] * 3 + [SIGMA_M**2] * 3)
DOUBT = Doubt("predicted motion", "translation along x is not seen but predicted, to ±0.3 m a second")
WEAK = Doubt("weak direction", "36% agree in the weakest direction")


def true_positions(seed=3):
    """Return positions along a straight way whose speed changes at random, about 3 m/s."""
    rng = np.random.default_rng(seed)
    speeds = 3.0 + np.cumsum(rng.normal(0.0, 0.3 * np.sqrt(INTERVAL_S), FRAMES))
    return np.concatenate([[0.0], np.cumsum(speeds * INTERVAL_S)])[:FRAMES]


def tracked(unseen, *, guess, noise_m=0.0, seed=5):
    """Return results of a way of which some frames do not show the motion along x; every third is a keyframe.

    Args:
        unseen: Numbers of these frames.
        guess: Way of these from frame to frame, as tracking has it, metres.
        noise_m: Of the poses across the way.
        seed: Of the noise.
    """
    x, rng = true_positions(), np.random.default_rng(seed)
    results, node = [], 0
    for k in range(FRAMES):
        key = 3 * ((k - 1) // 3) if k else 0
        way = guess * (k - key) if k in unseen else x[k] - x[key]
        begin = results[key].T_world_body[0, 3] if k else 0.0
        turned = rotation_exp(np.array([0.0, 0.0, rng.normal(0.0, noise_m)]))
        T_world_body = transform(turned, np.array([begin + way, rng.normal(0.0, noise_m), 0.0]))
        is_keyframe = k % 3 == 0
        diagnostics = Diagnostics(
            100, 100, 100, 0.01, "m", "map", "translation along x" if k in unseen else ""
        )
        T_key_body = inverse(results[3 * node].T_world_body) @ T_world_body if k else np.eye(4)
        covariance = COVARIANCE + (np.diag([0.0] * 3 + [4.0, 0.0, 0.0]) if k in unseen else 0.0)
        factors = ()
        if is_keyframe and k:
            factors = (BetweenFactor(node, node + 1, T_key_body, np.linalg.inv(covariance)),)
            node += 1
        results.append(
            FrameResult(
                int(k * INTERVAL_S * 1e9),
                node,
                np.eye(4) if is_keyframe else T_key_body,
                T_world_body,
                is_keyframe,
                diagnostics,
                factors,
                doubts=(DOUBT,) if k in unseen else (),
                covariance=covariance,
                unseen=UnseenMotions(ALONG, ALONG, np.array([30.0]), COVARIANCE, (DOUBT,))
                if k in unseen
                else None,
            )
        )
    return results


def lengths(results, begin=0, end=FRAMES):
    return np.diff([result.T_world_body[0, 3] for result in results[begin:end]])


def test_between_two_known_velocities_the_speed_goes_from_one_to_the_other():
    x, before_m, after_m = true_positions(), [], []
    for begin in range(20, 90, 3):
        unseen = range(begin, begin + 15)
        before = tracked(unseen, guess=x[begin - 1] - x[begin - 2])
        after = smooth_unseen_motions(before)
        for results, off_m in ((before, before_m), (after, after_m)):
            off_m.append(lengths(results, begin - 1, begin + 15).sum() - (x[begin + 14] - x[begin - 1]))
        np.testing.assert_allclose(lengths(after, 0, begin), lengths(before, 0, begin))
        np.testing.assert_allclose(lengths(after, begin + 17), lengths(before, begin + 17), atol=1e-9)
    assert np.std(after_m) < 0.75 * np.std(before_m)


def test_errors_are_as_large_as_their_covariances_say():
    ratios = []
    for begin in range(20, 90, 10):
        unseen, x = range(begin, begin + 12), true_positions()
        after = smooth_unseen_motions(tracked(unseen, guess=0.0))
        factors = {f.j: f for r in after for f in r.factors}
        errors, variance = 0.0, 0.0
        for k in unseen:
            if k % 3 == 0:
                factor = factors[k // 3]
                errors += factor.T_i_j[0, 3] - (x[k] - x[k - 3])
                variance += np.linalg.inv(factor.information)[3, 3]
        ratios.append(errors**2 / variance)
    assert 0.1 < np.mean(ratios) < 2.0


def test_a_log_that_begins_where_nothing_shows_the_motion_gets_its_velocity_from_later():
    before = tracked(range(1, 9), guess=0.0)

    after = smooth_unseen_motions(before)

    assert lengths(after, 0, 9).sum() == pytest.approx(true_positions()[8], rel=0.15)
    assert np.sqrt(after[3].covariance[3, 3]) < 0.2
    assert np.sqrt(after[1].covariance[3, 3]) < 0.2


def test_frames_are_doubtful_where_the_motion_of_no_second_is_known():
    brief, long = (smooth_unseen_motions(tracked(range(50, end), guess=0.3)) for end in (53, 80))

    assert not any(result.doubts for result in brief)
    doubtful = [k for k, result in enumerate(long) if result.doubts]
    assert set(range(60, 70)) <= set(doubtful) <= set(range(51, 79))
    assert long[65].doubts[0].text.startswith("translation along x is not seen but predicted, to ±0.")


def test_other_doubts_stay():
    before = tracked(range(50, 53), guess=0.3)
    before[51] = replace(before[51], doubts=(WEAK, DOUBT))

    assert smooth_unseen_motions(before)[51].doubts == (WEAK,)


def test_noise_across_the_way_does_not_shorten_it():
    unseen, x = range(40, 80), true_positions()
    after = smooth_unseen_motions(tracked(unseen, guess=0.3, noise_m=0.01))

    assert lengths(after, 39, 80).sum() == pytest.approx(x[79] - x[39], rel=0.15)


def test_what_surfaces_show_in_part_counts_as_much():
    x = true_positions()
    before = tracked(range(50, 70), guess=0.0)
    part = 0.5 * (x[52] - x[49]) + 0.25
    shown = UnseenMotions(ALONG, ALONG, np.array([1e-4]), COVARIANCE)
    T_shown = transform(np.eye(3), np.array([part, 0.0, 0.0]))
    factor = replace(before[51].factors[0], T_i_j=T_shown)
    before[51] = replace(before[51], unseen=shown, factors=(factor,))

    after = smooth_unseen_motions(before)

    assert after[51].factors[0].T_i_j[0, 3] == pytest.approx(part, abs=1e-3)


def test_keyframes_agree_with_their_factors_and_frames_with_their_keyframes():
    after = smooth_unseen_motions(tracked(range(50, 70), guess=0.0))

    poses = {result.node: result.T_world_body for result in after if result.is_keyframe}
    for result in after:
        T_world_body = poses[result.node] @ result.T_node_body
        np.testing.assert_allclose(result.T_world_body, T_world_body, atol=1e-9)
        for factor in result.factors:
            np.testing.assert_allclose(poses[factor.i] @ factor.T_i_j, poses[factor.j], atol=1e-9)


@pytest.mark.parametrize("unseen", [(), range(15, 120), range(1, 102)])
def test_nothing_changes_without_unseen_motions_or_without_two_seconds_that_show_the_acceleration(unseen):
    before = tracked(unseen, guess=0.3)

    after = smooth_unseen_motions(before)

    assert all(a is b for a, b in zip(after, before, strict=True))


def test_lost_frames_and_other_sub_maps_are_left_out():
    before = tracked(range(50, 60), guess=0.0)
    before[55] = lost_frame(before[55].stamp_ns, before[54].T_world_body)
    first = before[90]
    before[90:] = [
        replace(result, factors=() if result is first else result.factors) for result in before[90:]
    ]

    after = smooth_unseen_motions(before)

    assert after[55].node is None
    assert after[54].T_world_body[0, 3] == pytest.approx(true_positions()[54], abs=0.1)
    np.testing.assert_array_equal(after[90].T_world_body, before[90].T_world_body)
