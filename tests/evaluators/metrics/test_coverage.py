"""Which share of a log has a pose."""

import numpy as np
import pytest

from mapper.evaluators.metrics.coverage import frame_coverage, time_coverage

MS = 1_000_000
FRAMES_NS = 7_000_000_000 + np.arange(100, dtype=np.int64) * 33 * MS


def values_of(metrics):
    return {metric.name: metric.value for metric in metrics}


def test_every_frame_with_a_pose_counts_and_the_longest_run_without_is_told():
    kept = np.ones(100, bool)
    kept[[10, 40, 41, 42, 99]] = False
    values = values_of(frame_coverage(FRAMES_NS, FRAMES_NS[kept]))
    assert values == {
        "coverage, frames with a pose": 95.0,
        "frames without a pose": 5,
        "gaps": 3,
        "longest gap": pytest.approx(4 * 0.033),
    }


def test_rounded_stamps_still_belong_to_their_frames_but_a_neighbour_s_do_not():
    rounded = (FRAMES_NS + 4 * MS)[::2]
    assert values_of(frame_coverage(FRAMES_NS, rounded))["coverage, frames with a pose"] == 50.0
    quick = FRAMES_NS[0] + np.arange(100, dtype=np.int64) * 5 * MS  # 20 ms would reach four frames on
    assert values_of(frame_coverage(quick, quick[::2]))["coverage, frames with a pose"] == 50.0


def test_without_frames_the_truth_s_time_counts_up_to_pauses():
    poses_ns = np.concatenate([FRAMES_NS[20:50], FRAMES_NS[80:]])
    values = values_of(time_coverage(poses_ns, begin_ns=int(FRAMES_NS[0]), end_ns=int(FRAMES_NS[-1])))
    assert values["gaps"] == 2
    assert values["longest gap"] == pytest.approx(31 * 0.033)
    assert values["coverage, share of the truth's time"] == pytest.approx(100.0 * (99 - 20 - 31) / 99)


def test_a_pause_of_the_log_is_a_gap_too():
    frames_ns = np.array([*range(0, 1000, 100), *range(3000, 4000, 100)], np.int64) * 1_000_000
    found = {metric.name: metric.value for metric in frame_coverage(frames_ns, frames_ns)}
    assert (found["gaps"], found["longest gap"]) == (1, 2.1)
    assert found["frames without a pose"] == 0
