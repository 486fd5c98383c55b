"""Velocity filter: predicted poses follow what is observed, and a velocity that is known better otherwise."""

from types import SimpleNamespace

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse, log
from mapper.odometry.local_map.pose.velocity_filter import VelocityFilter

STEP_NS = 66_000_000
T_BODY_CAMERA = exp(np.array([-1.2, 1.2, -1.2]), np.array([0.05, 0.0, 0.1]))
VELOCITY = np.array([0.0, 0.0, 0.3, 0.6, 0.0, 0.0])
"""rad/s and m/s of the body."""


def frame(k, T_world_body):
    return SimpleNamespace(
        stamp_ns=k * STEP_NS,
        body_pose=T_world_body,
        observation=SimpleNamespace(T_body_camera=T_BODY_CAMERA),
    )


def walk(count, *, sigmas, noise=(0.0,) * 6, jumps=(), doubtful=(), seed=1):
    """A walk along an arc whose poses have errors, by direction; the filter and the last pose."""
    rng = np.random.default_rng(seed)
    velocities, last = VelocityFilter(), None
    for k in range(count):
        step = k * STEP_NS / 1e9 * VELOCITY
        error = rng.normal(size=6) * noise
        if k in jumps:
            error[3] += 0.5
        tracked = frame(k, exp(step[:3], step[3:]) @ exp(error[:3], error[3:]))
        if last is not None:
            velocities.add(tracked, np.diag(np.square(sigmas)), last, is_doubtful=k in doubtful)
        last = tracked
    return velocities, last


def miss(velocities, last, steps=1.0):
    """Return the twist from the pose that the true velocity leads to, to the predicted one."""
    elapsed_s = steps * STEP_NS / 1e9
    T_camera_world = velocities.predicted(last.stamp_ns + round(steps * STEP_NS), last)
    T_world_body = inverse(T_BODY_CAMERA @ T_camera_world)
    expected = last.body_pose @ exp(elapsed_s * VELOCITY[:3], elapsed_s * VELOCITY[3:])
    return np.concatenate(log(inverse(expected) @ T_world_body))


def test_a_steady_motion_is_continued_also_across_dropped_frames():
    velocities, last = walk(30, sigmas=(1e-3,) * 6)
    for steps in (1.0, 4.0):
        np.testing.assert_allclose(miss(velocities, last, steps), 0.0, atol=1e-9)
    assert velocities.predicted(last.stamp_ns + 11 * STEP_NS, last) is None


def test_where_poses_are_uncertain_the_velocity_is_that_of_many():
    """Errors of 5 mm along x alone, of poses that are known to 2 cm there: two poses would err by 7 mm."""
    misses = [
        miss(
            *walk(
                60,
                sigmas=(1e-3, 1e-3, 1e-3, 0.02, 1e-3, 1e-3),
                noise=(0.0, 0.0, 0.0, 5e-3, 0.0, 0.0),
                seed=seed,
            )
        )[3]
        for seed in range(20)
    ]
    assert np.sqrt(np.mean(np.square(misses))) < 3e-3


@pytest.mark.parametrize(("doubtful", "moved"), [((), True), ((39,), False)])
def test_a_jump_is_followed_unless_it_is_doubtful(doubtful, moved):
    velocities, last = walk(
        40, sigmas=(1e-3,) * 6, noise=(0.0,) * 3 + (1e-3,) * 3, jumps=(39,), doubtful=doubtful
    )
    assert (abs(miss(velocities, last)[3]) > 0.4) == moved


def test_a_motion_that_is_doubted_twice_counts():
    velocities, last = walk(
        40, sigmas=(1e-3,) * 6, noise=(0.0,) * 3 + (1e-3,) * 3, jumps=(39,), doubtful=(38, 39)
    )
    assert abs(miss(velocities, last)[3]) > 0.4


def test_nothing_is_predicted_after_a_restart():
    velocities, last = walk(30, sigmas=(1e-3,) * 6)
    velocities.restart()
    assert velocities.predicted(last.stamp_ns + STEP_NS, last) is None
