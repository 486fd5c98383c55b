"""Precision and recall of loop closures against the truth."""

from types import SimpleNamespace

import numpy as np
import pytest

from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.loops import loop_metrics, loop_metrics_of_run, revisits_of
from mapper.loops.closure import LoopClosure
from mapper.loops.config import PlaceLoopsConfig, ScanLoopsConfig
from tests.support.planar import at


@pytest.fixture
def truth() -> Trajectory:
    """Ten seconds out along x at 0.5 m/s and ten seconds back, a pose a second."""
    x = [0.5 * (k if k <= 10 else 20 - k) for k in range(21)]
    stamps_ns = np.arange(21) * NS_PER_S
    return Trajectory(stamps_ns, np.array([at(value) for value in x]))


def closure(i: int, j: int, x: float, *, verdict: str = "accepted") -> LoopClosure:
    return LoopClosure(
        i=i,
        j=j,
        stamp_i_ns=i * NS_PER_S,
        stamp_j_ns=j * NS_PER_S,
        proposed_by="places",
        verdict=verdict,
        reason="" if verdict == "accepted" else "isvd: no",
        T_i_j=at(x),
        information=np.eye(6),
    )


def values(metrics) -> dict[str, float]:
    return {metric.name: metric.value for metric in metrics}


def test_revisits_are_near_alike_and_long_ago(truth):
    revisit = revisits_of(truth.stamps_ns, truth)
    assert revisit.nonzero()[0].tolist() == list(range(12, 21))  # at 12 s as at 7 s, half a metre away


def test_looking_the_other_way_is_no_revisit(truth):
    T = truth.T_world_body.copy()
    T[11:, :3, :3] = at(0.0, yaw=np.pi)[:3, :3]
    assert not revisits_of(truth.stamps_ns, Trajectory(truth.stamps_ns, T)).any()


def test_a_loop_off_the_truth_is_wrong(truth):
    told = values(loop_metrics([closure(2, 18, 0.05), closure(3, 17, 0.5)], truth.stamps_ns, truth))
    assert told["loops"] == 2
    assert told["loops wrongly accepted"] == 1


def test_rejected_candidates_count_neither_way(truth):
    told = values(loop_metrics([closure(3, 17, 0.5, verdict="rejected")], truth.stamps_ns, truth))
    assert told.pop("true revisits") == 9
    assert set(told.values()) == {0}


def test_a_revisit_with_two_loops_counts_once(truth):
    told = values(loop_metrics([closure(2, 18, 0.0), closure(1, 18, 0.5)], truth.stamps_ns, truth))
    assert (told["true revisits with a loop"], told["true revisits"]) == (1, 9)


def test_without_revisits_there_are_none(truth):
    told = values(loop_metrics([], truth.stamps_ns[:10], truth))
    assert set(told.values()) == {0}


def test_what_the_truth_does_not_cover_is_not_judged(truth):
    late = truth.stamps_ns + 1000 * NS_PER_S
    assert not revisits_of(late, truth).any()


def test_where_looks_are_rare_a_loop_counts_for_the_keyframes_around(truth):
    told = values(loop_metrics([closure(2, 18, 0.0)], truth.stamps_ns, truth, searched_every_m=1.0))
    assert told["true revisits with a loop"] == 5  # 16 to 20 s, half a metre apart


@pytest.mark.parametrize(
    ("loops", "found"), [(ScanLoopsConfig(min_motion_m=1.0), 5), (PlaceLoopsConfig(min_motion_m=1.0), 1)]
)
def test_scans_are_searched_for_loops_once_in_some_metres(truth, loops, found):
    run = SimpleNamespace(config=SimpleNamespace(loops=loops), loops=[closure(2, 18, 0.0)], keyframes=truth)
    assert values(loop_metrics_of_run(run, truth))["true revisits with a loop"] == found
