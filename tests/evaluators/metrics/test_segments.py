"""Relative errors over lengths, compared with a plain reading of the benchmark's own definition."""

from itertools import pairwise

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.core.geometry import angle_between, exp, inverse, transform
from mapper.evaluators.metrics.segments import (
    KITTI_LENGTHS_M,
    length_records,
    lengths_for,
    segment_errors,
    segment_metrics,
)
from mapper.evaluators.metrics.trajectory_errors import Matched, associate
from mapper.sources.trajectory_files import read_kitti
from tests.support.paths import DATA

TRAJECTORIES = DATA / "trajectories"
needs_trajectories = pytest.mark.skipif(not TRAJECTORIES.is_dir(), reason=f"{TRAJECTORIES} is not here")


def drive(n, *, seed, step_m=1.0):
    rng = np.random.default_rng(seed)
    T, poses = np.eye(4), []
    for _ in range(n):
        T = T @ exp(rng.normal(0.0, 0.03, 3), np.array([step_m * rng.uniform(0.5, 1.0), 0.0, 0.0]))
        poses.append(T)
    return np.array(poses)


def drifted(poses, *, seed):
    rng = np.random.default_rng(seed)
    steps = [inverse(a) @ b for a, b in pairwise(poses)]
    out = [poses[0]]
    for step in steps:
        out.append(out[-1] @ step @ exp(rng.normal(0.0, 1e-3, 3), rng.normal(0.0, 0.01, 3)))
    return np.array(out)


def matched_of(estimate, truth):
    return Matched(np.arange(len(truth), dtype=np.int64), estimate, truth)


def by_the_book(estimate, truth, lengths_m):
    """Geiger et al. 2012 as their development kit words it: loops, and one segment after the other."""
    along = [0.0]
    for a, b in pairwise(truth):
        along.append(along[-1] + float(np.linalg.norm(b[:3, 3] - a[:3, 3])))
    found = {length: [] for length in lengths_m}
    for first in range(0, len(truth), 10):
        for length in lengths_m:
            last = next((k for k in range(first, len(truth)) if along[k] > along[first] + length), None)
            if last is None:
                continue
            true = np.linalg.inv(truth[first]) @ truth[last]
            ours = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(ours) @ true
            angle = angle_between(np.eye(3), error[:3, :3])
            found[length].append((np.linalg.norm(error[:3, 3]) / length, angle / length))
    return {length: np.array(rows).reshape(-1, 2) for length, rows in found.items()}


@pytest.mark.parametrize("seed", range(3))
def test_the_benchmark_s_definition_is_met(seed):
    truth = drive(700, seed=seed)
    estimate = drifted(truth, seed=seed + 10)
    book = by_the_book(estimate, truth, KITTI_LENGTHS_M)

    ours = segment_errors(matched_of(estimate, truth), KITTI_LENGTHS_M)

    assert [error.length_m for error in ours] == list(KITTI_LENGTHS_M)
    for error in ours:
        rows = book[error.length_m]
        assert len(error) == len(rows)
        # The error's inverse is as long and turns as far.
        np.testing.assert_allclose(error.translation_ratio, rows[:, 0], rtol=1e-7)
        np.testing.assert_allclose(error.rotation_radpm, rows[:, 1], rtol=1e-6, atol=1e-12)
    assert len(book[100.0]) > 30 > 0 == len(book[800.0])


def test_a_scaled_straight_drive_errs_by_its_scale_over_every_length():
    truth = np.array([transform(np.eye(3), [0.1 * k, 0.0, 0.0]) for k in range(400)])
    estimate = truth.copy()
    estimate[:, :3, 3] *= 1.02
    errors = segment_errors(matched_of(estimate, truth), (1.0, 2.0, 5.0, 500.0))
    # A segment ends at the first pose beyond its length, so it is up to a step too long.
    for error, step_m in zip(errors[:3], (0.1, 0.1, 0.1), strict=True):
        assert error.translation_ratio.min() >= 0.02 * (1.0 - 1e-9)
        assert error.translation_ratio.max() <= 0.02 * (1.0 + step_m / error.length_m) + 1e-9
        assert not error.rotation_radpm.any()
    assert len(errors[3]) == 0
    values = {metric.name: metric.value for metric in segment_metrics(errors)}
    assert values["segments, all lengths"] == sum(map(len, errors[:3]))
    assert values["relative translation mean, all lengths"] == pytest.approx(2.1, abs=0.11)
    assert segment_metrics(errors[2:3])[1].name == "relative translation mean, 5 m"
    assert [row["length_m"] for row in length_records(errors)] == [1.0, 2.0, 5.0]


def test_segments_much_longer_than_said_are_left_out():
    sparse = np.array([transform(np.eye(3), [1.5 * k, 0.0, 0.0]) for k in range(40)])
    one_m, three_m = segment_errors(matched_of(sparse, sparse), (1.0, 2.9))
    assert (len(one_m), len(three_m)) == (0, 4)
    assert segment_metrics([one_m]) == []


def test_lengths_suit_the_path():
    assert lengths_for(3700.0) == lengths_for(800.0) == KITTI_LENGTHS_M
    assert lengths_for(799.0) == (20.0, 50.0, 100.0, 200.0)
    assert lengths_for(7.1) == (0.2, 0.5, 1.0, 2.0)
    assert lengths_for(0.3) == (0.1,)
    assert lengths_for(0.1) == ()


@pytest.mark.parametrize("length", [0.0, -1.0, np.nan, np.inf])
def test_lengths_that_are_none_are_refused(length):
    truth = drive(20, seed=0)
    with pytest.raises(DataError, match="lengths must be > 0"):
        segment_errors(matched_of(truth, truth), (1.0, length))


@needs_trajectories
def test_a_real_drive_of_3_7_km_has_the_published_drift():
    """ORB-SLAM2 publishes 0.70 % and 0.25°/100 m for sequence 00 (Mur-Artal & Tardós 2017, table I)."""
    estimate, truth = (read_kitti(TRAJECTORIES / f"KITTI_00_{name}.txt") for name in ("ORB", "gt"))
    errors = segment_errors(associate(estimate, truth), lengths_for(truth.path_length_m))
    values = {metric.name: metric.value for metric in segment_metrics(errors)}
    assert values["relative translation mean, all lengths"] == pytest.approx(0.70, abs=0.005)
    assert np.degrees(values["relative rotation mean, all lengths"]) * 100.0 == pytest.approx(0.25, abs=0.005)
