"""Paths over a whole log against the truth: drift, steps, and paths of which too little is left."""

import numpy as np
import pytest

from mapper.core.geometry import exp
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.odometry import (
    ONE_FRAME,
    ONE_SECOND,
    OdometryRun,
    PathErrors,
    assess_run,
    step_for,
)

FRAME_NS = 100_000_000


def path(n=41, *, scale=1.0, period_ns=FRAME_NS):
    """Along x at 1 m a frame, with a swing in y."""
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = scale * np.arange(n)
    T[:, 1, 3] = scale * np.sin(np.arange(n))
    return Trajectory(np.arange(n, dtype=np.int64) * period_ns, T)


def run_of(trajectory, frames=41):
    return OdometryRun("any", frames, failures=0, seconds=2.0, trajectory=trajectory)


def test_the_truth_seen_from_elsewhere_has_no_errors():
    truth = path()
    T_map_world = exp(np.array([0.4, -1.0, 2.0]), np.array([5.0, 6.0, 7.0]))
    run = assess_run(run_of(truth.moved(T_map_world)), truth, ONE_SECOND)

    errors = run.errors
    assert max(errors.ate_m, errors.rpe_m, errors.rpe_rad, errors.drift_ratio) < 1e-7
    assert run.matched.position_errors_m.max() < 1e-9
    assert run.matched.rotation_errors_rad.max() < 1e-7
    np.testing.assert_allclose(run.trajectory.T_world_body, truth.T_world_body, atol=1e-9)
    assert (run.coverage, run.frames_per_s) == (1.0, 20.5)


def test_drift_is_the_share_of_the_way_that_is_missing():
    errors = assess_run(run_of(path(scale=0.95)), path(), ONE_SECOND).errors
    # A stretch along the swinging path is longer than the straight line between its ends.
    assert 0.03 < errors.drift_ratio <= 0.05
    assert errors.rpe_m == pytest.approx(0.05 * 10.0, rel=0.02)


def test_a_step_is_a_second_where_the_log_has_one():
    assert step_for(path(20).stamps_ns) == ONE_SECOND
    assert step_for(path(10).stamps_ns) == ONE_SECOND  # 0.9 s is near enough
    assert step_for(path(9).stamps_ns) == ONE_FRAME
    assert step_for(path(20, period_ns=1_500_000_000).stamps_ns) == ONE_FRAME
    assert step_for(path(1).stamps_ns) == ONE_FRAME
    assert (ONE_SECOND.text, ONE_FRAME.text) == ("1 s", "1 frame")


def test_frames_without_a_pose_are_uncovered_and_not_judged():
    truth = path()
    half = Trajectory(truth.stamps_ns[:10], truth.T_world_body[:10])
    run = assess_run(run_of(half), truth, ONE_SECOND)
    assert run.coverage == pytest.approx(10 / 41)
    assert len(run.matched) == 10


@pytest.mark.parametrize("left", [0, 2])
def test_too_few_poses_have_no_errors(left):
    truth = path()
    run = run_of(Trajectory(truth.stamps_ns[:left], truth.T_world_body[:left]))
    assert assess_run(run, truth, ONE_SECOND).errors == PathErrors()
    assert assess_run(run_of(truth), None, ONE_SECOND).errors == PathErrors()


def test_pieces_shorter_than_a_step_have_no_relative_error():
    truth = path()
    piece = Trajectory(truth.stamps_ns[:5], truth.T_world_body[:5])
    errors = assess_run(run_of(piece), truth, ONE_SECOND).errors
    assert errors.rpe_m is None
    assert errors.rpe_rad is None
    assert errors.ate_m < 1e-9
