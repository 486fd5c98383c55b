"""NEES of relative poses, on chains whose noise is known."""

import numpy as np
import pytest

from mapper.core.geometry import exp
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.consistency import drift_metrics, factor_nees, window_nees
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.odometry.base import Diagnostics
from mapper.run.frame_records import FrameRecord
from mapper.run.pose_covariances import UncertainPoses

NODES, STEP_NS = 120, 250_000_000
SIGMAS = PoseSigmas(rotation_rad=0.002, translation_m=0.005)
FIGURES = Diagnostics(100, 50, 50, 1.0, "px", "map")


def chain(*, errors_times=1.0, seed=0):
    """Return truth and a chain of keyframes, with factors that err so many times what they say."""
    rng = np.random.default_rng(seed)
    sigma = errors_times * np.repeat([SIGMAS.rotation_rad, SIGMAS.translation_m], 3)
    true, found, factors = [np.eye(4)], [np.eye(4)], []
    for j in range(1, NODES):
        step = exp(rng.normal(0.0, 0.1, 3), rng.normal(0.1, 0.05, 3))
        error = rng.normal(0.0, sigma)
        measured = step @ exp(error[:3], error[3:])
        true.append(true[-1] @ step)
        found.append(found[-1] @ measured)
        factors.append(BetweenFactor(j - 1, j, measured, SIGMAS.information))
    stamps_ns = np.arange(NODES, dtype=np.int64) * STEP_NS
    graph = PoseGraph(dict(enumerate(found)), dict(enumerate(stamps_ns.tolist())), factors)
    return Trajectory(stamps_ns, np.array(true)), Trajectory(stamps_ns, np.array(found)), graph


def keyframes(stamps_ns):
    sigmas = (SIGMAS.rotation_rad,) * 3 + (SIGMAS.translation_m,) * 3
    return [
        FrameRecord(int(stamp_ns), "tracked", node, True, FIGURES, (), sigmas)
        for node, stamp_ns in enumerate(stamps_ns)
    ]


@pytest.mark.parametrize("errors_times", [1.0, 3.0])
def test_it_is_one_where_errors_are_as_large_as_they_are_said_to_be(errors_times):
    of_factors, of_windows, of_steps = [], [], []
    for seed in range(4):
        truth, found, graph = chain(errors_times=errors_times, seed=seed)
        of_factors.append(factor_nees(graph.factors, graph, truth).mean)
        of_windows.append(window_nees(found, graph, keyframes(found.stamps_ns), truth).mean)
        steps = window_nees(found, graph, keyframes(found.stamps_ns), truth, window_ns=1)
        assert steps.count == NODES - 1
        of_steps.append(steps.mean)
    assert np.mean(of_factors) == pytest.approx(errors_times**2, rel=0.15)
    assert np.mean(of_windows) == pytest.approx(errors_times**2, rel=0.25)
    assert np.mean(of_steps) == pytest.approx(errors_times**2, rel=0.15)


def test_a_frame_s_own_covariance_takes_part():
    truth, found, graph = chain()
    offset = exp(np.zeros(3), np.array([0.2, 0.0, 0.0]))
    moved = found.T_world_body.copy()
    moved[8] = moved[8] @ offset
    records = keyframes(found.stamps_ns)
    least, most = (
        window_nees(
            Trajectory(found.stamps_ns, moved),
            graph,
            [
                *records[:8],
                FrameRecord(records[8].stamp_ns, "tracked", 8, False, FIGURES, (), sigmas),
                *records[9:],
            ],
            truth,
        ).mean
        for sigmas in ((0.1,) * 6, (1e-4,) * 6)
    )
    assert least < 1.5
    assert most > least + 0.1


def test_without_a_truth_at_the_time_nothing_is_compared():
    truth, found, graph = chain()
    later = Trajectory(truth.stamps_ns + 10**12, truth.T_world_body)
    assert window_nees(found, graph, keyframes(found.stamps_ns), later).count == 0
    assert factor_nees(graph.factors, graph, later).count == 0


def test_the_expected_drift_is_that_of_the_last_pose_that_is_not_doubtful():
    stamps_ns = np.arange(3, dtype=np.int64) * STEP_NS
    T_world_body = np.array([exp(np.zeros(3), np.array([x, 0.0, 0.0])) for x in (0.0, 4.0, 8.0)])
    covariances = np.array([np.diag([0.0] * 3 + [sigma_m**2, 0.0, 0.0]) for sigma_m in (0.0, 0.2, 0.9)])
    poses = UncertainPoses(Trajectory(stamps_ns, T_world_body), np.array([False, False, True]), covariances)
    told = {metric.quantity: metric.value for metric in drift_metrics(poses)}
    assert told == pytest.approx({"uncertainty of the last position": 0.2, "expected drift": 2.5})
    unknown = UncertainPoses(poses.trajectory, poses.is_doubtful, np.full((3, 6, 6), np.nan))
    assert drift_metrics(unknown) == []
