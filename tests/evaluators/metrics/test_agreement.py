"""Agreement of views: drift and jitter show without a truth, in scans and in images."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.core.frames import Scan
from mapper.core.geometry import exp
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.agreement import (
    CommonViews,
    agreement_metrics,
    comparison_metrics,
    which_is_better,
)
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from tests.support.logs import log_in_memory, memory_entry
from tests.support.street_scans import SENSOR, on_street, still_scan, street


@pytest.fixture(scope="module")
def drive():
    """Twelve scans along a street, 0.5 s and 1 m apart, and their true poses."""
    poses = np.array([on_street(street(7), 20.0 + k) for k in range(12)])
    stamps_ns = np.arange(12) * (NS_PER_S // 2)
    scans = [
        Scan(int(stamp_ns), still_scan(street(7), SENSOR, T, seed=k), np.zeros(3))
        for k, (stamp_ns, T) in enumerate(zip(stamps_ns, poses, strict=True))
    ]
    log = log_in_memory([memory_entry(scan.stamp_ns, scan) for scan in scans], sensor="lidar")
    return log, Trajectory(stamps_ns, poses)


def drifting(truth, metres_per_frame, *, jitter_m=0.0):
    """The trajectory with an error to the left that grows, and noise."""
    rng = np.random.default_rng(3)
    errors_m = metres_per_frame * np.arange(len(truth)) + rng.normal(0.0, jitter_m, len(truth))
    errors = [exp(np.zeros(3), np.array([0.0, error_m, 0.0])) for error_m in errors_m]
    return replace(truth, T_world_body=truth.T_world_body @ np.array(errors))


def disagreements_of(log, trajectory):
    return CommonViews(log).disagreements(trajectory)


def values_of(metrics):
    return [metric.value for metric in metrics]


def test_disagreement_of_scans_grows_with_the_error_of_the_poses(drive):
    log, truth = drive
    measured = {
        name: values_of(agreement_metrics(disagreements_of(log, trajectory)))
        for name, trajectory in {
            "truth": truth,
            "drift": drifting(truth, 0.02),
            "more": drifting(truth, 0.04),
            "jitter": drifting(truth, 0.0, jitter_m=0.05),
        }.items()
    }
    pairs, disagreement_m, low_m, high_m = measured["truth"]
    assert pairs == 66
    assert disagreement_m < 0.012
    assert low_m <= disagreement_m <= high_m
    assert 0.02 < measured["drift"][1] < 0.1
    assert measured["more"][1] == pytest.approx(2.0 * measured["drift"][1], rel=0.3)
    assert measured["jitter"][1] > 3.0 * disagreement_m


def test_the_better_of_two_trajectories_is_told_only_where_the_log_shows_it(drive):
    log, truth = drive
    right, wrong = (disagreements_of(log, drifting(truth, drift_m)) for drift_m in (0.002, 0.02))
    less = comparison_metrics(right, wrong)
    pairs, mean_m, low_m, high_m = values_of(less)
    assert pairs == 66
    assert 0.0 < low_m < mean_m < high_m
    assert which_is_better(less, "a", "b").startswith("a agrees")
    assert which_is_better(comparison_metrics(wrong, right), "a", "b").startswith("b agrees")
    assert values_of(comparison_metrics(right, right))[1:] == [0.0, 0.0, 0.0]
    assert "cannot be told apart" in which_is_better(comparison_metrics(right, right), "a", "b")


def test_pairs_that_only_one_run_has_poses_for_are_left_out(drive):
    log, truth = drive
    half = Trajectory(truth.stamps_ns[:6], truth.T_world_body[:6])
    other = Trajectory(truth.stamps_ns[6:], truth.T_world_body[6:])
    whole, part = disagreements_of(log, truth), disagreements_of(log, half)
    assert values_of(comparison_metrics(whole, part))[0] == 15
    with pytest.raises(DataError, match="no views in common"):
        comparison_metrics(part, disagreements_of(log, other))


def test_frames_without_a_common_place_cannot_be_judged(drive):
    log, truth = drive
    alone = Trajectory(truth.stamps_ns[:1], truth.T_world_body[:1])
    with pytest.raises(DataError, match="no two show one place"):
        disagreements_of(log, alone)


def test_images_disagree_by_the_error_of_their_poses(desk_log):
    source = open_source(desk_log, SourceConfig(last_frame=19))
    truth = source.truth
    right = disagreements_of(source, truth)
    wrong = disagreements_of(source, drifting(truth, 0.004))
    assert len(right.distances_m) > 50
    assert values_of(agreement_metrics(right))[1] < 0.01
    apart = np.diff(np.searchsorted(truth.stamps_ns, wrong.stamps_ns), axis=1)[:, 0]
    assert np.corrcoef(apart, wrong.distances_m)[0, 1] > 0.9
    assert values_of(comparison_metrics(right, wrong))[2] > 0.0
