"""Every warning about a run: found where there is reason, silent where there is none."""

import re
from dataclasses import replace

import numpy as np
import pytest

from mapper.core.doubts import Doubt
from mapper.core.geometry import exp, inverse
from mapper.core.trajectory import Trajectory
from mapper.graph.model import BetweenFactor, PoseSigmas
from mapper.loops.closure import Discrepancy
from mapper.run.frame_records import DISCONNECTED
from mapper.run.manifest import Levelling, RunWarning, SkippedFrame
from mapper.run.manifest_logs import AppendedLog
from mapper.run.pose_covariances import uncertain_poses
from mapper.run.results import aligned_truth
from mapper.run.verdict import find_warnings, merge_warnings
from mapper.sources.config import SourceConfig
from tests.support.loop_closures import loop
from tests.support.run_results import MANIFEST, STEP_NS, doubted, lost, results_of

INFORMATION = PoseSigmas(0.01, 0.02).information


def found(results, manifest=MANIFEST, kind=None):
    return [w for w in find_warnings(results, manifest) if kind is None or w.kind == kind]


def only(results, manifest=MANIFEST):
    (warning,) = found(results, manifest)
    return warning


def numbers_in(sentence):
    return [float(number) for number in re.findall(r"\d+(?:\.\d+)?", sentence)]


def with_loops(results, misses_m, *, reason="", miss_rad=0.0):
    """Loops over 100 frames, 5 m of path, that far from the odometry."""
    verdict = {"verdict": "rejected", "reason": reason, "weight": 0.0} if reason else {"weight": 1.0}
    loops = [
        replace(
            loop(i, i + 20, before=Discrepancy(miss_m, miss_rad), after=Discrepancy(0.0, 0.0), **verdict),
            stamp_i_ns=i * 5 * STEP_NS,
            stamp_j_ns=(i + 20) * 5 * STEP_NS,
        )
        for i, miss_m in enumerate(misses_m)
    ]
    return replace(results, loops=[*results.loops, *loops])


def test_a_good_run_has_none():
    assert found(results_of()) == []
    assert found(with_loops(results_of(), [0.1, 0.2, 0.29, 0.5])) == [
        w for w in found(with_loops(results_of(), [0.1, 0.2, 0.29, 0.5])) if w.kind != "loops"
    ]


REPEATED = doubted(Doubt("repeated image", "same image as 1 frames before"))
UNSEEN = doubted(unobservable="translation along x")


@pytest.mark.parametrize(
    ("frame", "indices", "count", "kind", "weight", "numbers"),
    [
        (lost(), [50], 200, "lost", "note", [1, 200]),
        (lost(), [50, 51, 52, 90, 91, 92], 200, "lost", "note", [6, 200]),
        (lost(), range(50, 61), 200, "lost", "doubt", [11, 200]),
        (lost(), range(50, 75), 200, "lost", "break", [25, 200]),
        (lost(), range(20, 180, 3), 200, "lost", "break", [54, 200]),
        (lost(DISCONNECTED), range(150, 200), 200, "left out", "break", [50, 200]),
        (doubted(), [12, 51, 99], 200, "doubtful", "note", [3, 200, 1.5]),
        (doubted(), range(100, 118), 2000, "doubtful", "note", [18, 2000, 0.9, 1.9]),
        (doubted(), range(100, 125), 2000, "doubtful", "doubt", [25, 2000, 1.2, 2.6]),  # too long to fill
        (REPEATED, range(10, 200, 10), 200, "doubtful", "note", [19, 200]),
        (REPEATED, range(100, 125), 200, "doubtful", "doubt", [25, 200]),
    ],
)
def test_frames_that_were_not_tracked(frame, indices, count, kind, weight, numbers):
    warning = only(results_of(count, changed=dict.fromkeys(indices, frame)))
    assert (warning.kind, warning.weight) == (kind, weight)
    assert numbers_in(warning.sentence)[: len(numbers)] == numbers


def test_where_frames_were_lost():
    warning = only(results_of(changed={k: lost() for k in (30, *range(101, 126))}))
    assert warning.where == "10.0 … 12.6 s"
    assert "for 2.6 s at the longest" in warning.sentence


def test_frames_that_are_left_out_do_not_count_as_lost_too():
    changed = {k: lost() for k in (140, 141)} | {k: lost(DISCONNECTED) for k in range(142, 200)}
    left_out, few = found(results_of(changed=changed))
    assert (left_out.kind, few.kind, few.weight, few.where) == ("left out", "lost", "note", "13.9 … 14.2 s")


def test_doubtful_frames_and_their_main_reasons():
    jumps = {k: doubted(Doubt("jump", f"jump of 0.{k} m where 0.09 m was predicted")) for k in range(11, 19)}
    some = {k: doubted(Doubt("disagreement", "12 inliers on one side of the image")) for k in range(51, 54)}
    warning = only(results_of(changed=jumps | some))
    assert (warning.kind, warning.weight, warning.where) == ("doubtful", "doubt", "1.0 … 1.9 s")
    numbers = numbers_in(warning.sentence)
    assert (numbers[:4], numbers[-5:]) == ([11, 200, 5.5, 0.9], [0.11, 0.09, 8, 12, 3])


def test_motions_that_nothing_shows_have_another_remedy_than_settings():
    warning = only(results_of(changed=dict.fromkeys(range(11, 23), UNSEEN)))
    assert "wheel odometry" in warning.suggestion

    results = results_of(changed=dict.fromkeys(range(11, 23), UNSEEN), sigmas=PoseSigmas(0.04, 0.05))
    (uncertain,) = found(results, kind="uncertainty")
    assert uncertain.suggestion == warning.suggestion  # not to come back, for loops

    few = dict.fromkeys(range(11, 14), UNSEEN) | {k: doubted() for k in range(20, 30)}
    assert not only(results_of(changed=few)).suggestion


def test_wheels_that_are_in_the_graph_are_not_asked_for():
    results = results_of(changed=dict.fromkeys(range(11, 23), UNSEEN))
    T = results.graph.T_world_node
    results.graph.add_factors(
        BetweenFactor(k - 1, k, inverse(T[k - 1]) @ T[k], INFORMATION, "wheel") for k in range(1, 40)
    )
    assert "wheel" not in only(results).suggestion


def test_loops_are_not_asked_for_where_a_path_has_none():
    (warning,) = found(results_of(sigmas=PoseSigmas(0.04, 0.05)), kind="uncertainty")
    assert "loops" not in warning.suggestion


def test_skipped_frames():
    manifest = MANIFEST.model_copy(
        update={"skipped": tuple(SkippedFrame(stamp_ns=k, reason="7.png: truncated") for k in range(3))}
    )
    assert only(results_of(), manifest).weight == "note"
    many = manifest.model_copy(update={"skipped": manifest.skipped * 10})
    warning = only(results_of(), many)
    assert (warning.weight, numbers_in(warning.sentence)) == ("doubt", [30, 200, 7])


def late(first, by_ns, count=200):
    return {k: k * STEP_NS + by_ns for k in range(first, count)}


def test_a_missing_stretch_of_the_log_is_a_gap():
    warning = only(results_of(stamps_ns=late(80, 2_000_000_000)))
    assert (warning.kind, warning.where) == ("gap", "7.9 … 10.0 s")
    assert numbers_in(warning.sentence) == [1, 2.1, 2.1, 0.1]
    assert found(results_of(stamps_ns=late(80, 300_000_000))) == []


def test_the_pause_before_a_second_session_is_none():
    session = AppendedLog(
        path="/b", kind="tum", fingerprint="", source=SourceConfig(), shift_ns=0, begins_ns=12 * 10**9
    )
    manifest = MANIFEST.model_copy(
        update={"input": MANIFEST.input.model_copy(update={"appended": (session,)})}
    )
    assert found(results_of(stamps_ns=late(80, 4_000_000_000)), manifest) == []


def test_loops_far_from_the_odometry():
    assert found(with_loops(results_of(), [0.2] * 5), kind="loops") == []
    warning = found(with_loops(results_of(), [2.5, 2.4, 2.6]), kind="loops")[0]
    assert warning.weight == "doubt"
    assert numbers_in(warning.sentence)[-5:] == [2.5, 0.0, 5.0, 0.3, 10.0]
    assert found(with_loops(results_of(), [0.0], miss_rad=0.3), kind="loops")[0].weight == "doubt"


def test_loops_that_contradict_each_other():
    refused = "solver: contradicts the rest of the graph, weight 0.00"
    some = with_loops(with_loops(results_of(), [0.0] * 5), [3.0] * 4, reason=refused)
    assert found(some, kind="loops") == []
    most = with_loops(with_loops(results_of(), [0.0] * 5), [3.0] * 6, reason=refused)
    (warning,) = found(most, kind="loops")
    assert warning.sentence.startswith("6 of 11 loops contradict the rest of the graph")


@pytest.mark.parametrize(
    ("levelling", "weight"),
    [
        (Levelling(method="camera", detail="only 3 flat patches seen"), "doubt"),
        (Levelling(method="planes", detail="no floor seen", has_floor=False), "note"),
    ],
)
def test_levelling_without_planes_or_floor(levelling, weight):
    warning = only(results_of(), MANIFEST.model_copy(update={"levelling": levelling}))
    assert (warning.kind, warning.weight) == ("levelling", weight)
    assert levelling.detail in warning.sentence


@pytest.mark.parametrize(("shift_m", "expected"), [(0.0, 0), (0.02, 0), (0.3, 1)])
def test_wheels_that_disagree(shift_m, expected):
    results = results_of()
    T = results.graph.T_world_node
    shift = exp(np.zeros(3), np.array([shift_m, 0.0, 0.0]))
    results.graph.add_factors(
        BetweenFactor(k - 1, k, inverse(T[k - 1]) @ T[k] @ shift, INFORMATION, "wheel") for k in range(1, 40)
    )
    assert len(found(results, kind="wheels")) == expected


def test_a_path_that_is_known_ever_less():
    assert found(results_of(sigmas=PoseSigmas(1e-4, 0.05)), kind="uncertainty") == []
    (warning,) = found(results_of(sigmas=PoseSigmas(0.04, 0.05)), kind="uncertainty")
    assert warning.weight == "doubt"
    assert "after 10.0 m of path" in warning.sentence
    assert found(results_of(sigmas=PoseSigmas(0.2, 1.0)), kind="uncertainty")[0].weight == "break"


def test_an_uncertain_heading_makes_no_step_uncertain():
    results = results_of(1000, wide_steps={1: PoseSigmas(0.04, 0.002)})
    assert results.poses.position_sigmas_m[-1] > 1.5
    assert found(results, kind="uncertainty") == []


def test_a_step_that_nothing_else_holds():
    results = results_of(wide_steps={20: PoseSigmas(0.01, 0.3)})
    (warning,) = found(results, kind="uncertainty")
    assert warning.where == "9.5 … 10.0 s"
    assert (
        "1 step between keyframes known to 0.2 m or 5° at best (1 σ), the worst to 0.52 m" in warning.sentence
    )
    # With a second way around it, nothing hangs on it.
    T = results.graph.T_world_node
    results.graph.add_factors(
        [BetweenFactor(18, 21, inverse(T[18]) @ T[21], PoseSigmas(0.001, 0.002).information, "loop")]
    )
    poses = uncertain_poses(results.trajectory, results.graph, results.records)
    assert found(replace(results, poses=poses), kind="uncertainty") == []


@pytest.mark.parametrize(("step", "count"), [(1, 0), (2, 0), (39, 0), (5, 1), (38, 1)])
def test_a_step_to_the_first_or_last_few_frames_is_none_between_parts(step, count):
    results = results_of(wide_steps={step: PoseSigmas(0.01, 0.3)})
    assert len(found(results, kind="uncertainty")) == count


def test_what_was_found_while_reading_stays_and_old_notes_count():
    manifest = MANIFEST.model_copy(
        update={
            "input": MANIFEST.input.model_copy(update={"notes": ("the camera stood", "10 Hz assumed")}),
            "warnings": (
                RunWarning(kind="frozen", sentence="the camera stood", weight="doubt"),
                RunWarning(kind="lost", sentence="of another solve", weight="break"),
            ),
        }
    )
    assert [(w.kind, w.sentence, w.weight) for w in found(results_of(), manifest)] == [
        ("frozen", "the camera stood", "doubt"),
        ("log", "10 Hz assumed", "note"),
    ]


def test_walls_of_merged_runs():
    assert merge_warnings("b", agreement=0.26, shared_voxels=200_000) == []
    assert merge_warnings("b", agreement=None, shared_voxels=200_000) == []
    assert merge_warnings("b", agreement=0.11, shared_voxels=300) == []
    (warning,) = merge_warnings("b", agreement=0.11, shared_voxels=200_000)
    assert "b: 11% of its walls" in warning.sentence
    assert "at least 15%" in warning.sentence


@pytest.mark.parametrize(("share", "kinds"), [(0.02, []), (0.05, ["truth"])])
def test_a_path_far_from_the_true_poses(share, kinds):
    results = results_of()
    stamps_ns, T_world_body = results.trajectory.stamps_ns, results.trajectory.T_world_body.copy()
    T_world_body[::2, 1, 3] += 2.0 * share * results.trajectory.path_length_m
    results = replace(results, truth=aligned_truth(Trajectory(stamps_ns, T_world_body), results.trajectory))
    assert [warning.kind for warning in found(results)] == kinds


@pytest.mark.parametrize(("is_mirrored", "kinds"), [(False, []), (True, ["truth"])])
def test_turns_that_are_not_the_true_ones(is_mirrored, kinds):
    results = results_of()
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])  # along the path, so that positions fit
    turned = [
        T @ exp(np.array([0.0, 0.0, 0.3 * np.sin(0.1 * k)]), np.zeros(3))
        for k, T in enumerate(results.trajectory.T_world_body)
    ]
    path = Trajectory(results.trajectory.stamps_ns, np.array(turned))
    truth = Trajectory(
        path.stamps_ns, mirror @ path.T_world_body @ mirror if is_mirrored else path.T_world_body
    )
    results = replace(results, trajectory=path, truth=aligned_truth(truth, path))
    assert [warning.kind for warning in found(results)] == kinds
