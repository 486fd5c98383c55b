"""Every warning about a run: found where there is reason, silent where there is none."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.doubts import Doubt
from mapper.core.geometry import exp, inverse
from mapper.core.trajectory import Trajectory
from mapper.graph.model import BetweenFactor, PoseSigmas
from mapper.loops.closure import Discrepancy, LoopClosure
from mapper.run.frame_outcomes import DISCONNECTED
from mapper.run.manifest import Levelling, RunWarning, SkippedFrame
from mapper.run.manifest_logs import AppendedLog
from mapper.run.pose_covariances import uncertain_poses
from mapper.run.results import aligned_truth
from mapper.run.verdict import find_warnings, merge_warnings
from mapper.sources.config import SourceConfig
from tests.support.run_results import MANIFEST, STEP_NS, doubted, lost, results_of

INFORMATION = PoseSigmas(0.01, 0.02).information


def found(results, manifest=MANIFEST, kind=None):
    return [w for w in find_warnings(results, manifest) if kind is None or w.kind == kind]


def only(results, manifest=MANIFEST):
    (warning,) = found(results, manifest)
    return warning


def with_loops(results, misses_m, *, reason="", miss_rad=0.0):
    """Loops over 100 frames, 5 m of path, that far from the odometry."""
    loops = [
        LoopClosure(
            i, i + 20, i * 5 * STEP_NS, (i + 20) * 5 * STEP_NS, "places",
            "rejected" if reason else "accepted", reason,
            T_i_j=np.eye(4), information=INFORMATION,
            before=Discrepancy(miss_m, miss_rad), after=Discrepancy(0.0, 0.0), weight=0.0 if reason else 1.0,
        )
        for i, miss_m in enumerate(misses_m)
    ]  # fmt: skip
    return replace(results, loops=[*results.loops, *loops])


def test_a_good_run_has_none():
    assert found(results_of()) == []
    assert found(with_loops(results_of(), [0.1, 0.2, 0.29, 0.5])) == [
        w for w in found(with_loops(results_of(), [0.1, 0.2, 0.29, 0.5])) if w.kind != "loops"
    ]


@pytest.mark.parametrize(
    ("indices", "weight"),
    [
        ([50], "note"),
        ([50, 51, 52, 90, 91, 92], "note"),
        (range(50, 61), "doubt"),
        (range(50, 75), "break"),
        (range(20, 180, 3), "break"),
    ],
)
def test_lost_frames(indices, weight):
    warning = only(results_of(changed={k: lost() for k in indices}))
    assert (warning.kind, warning.weight) == ("lost", weight)
    assert warning.sentence.startswith(f"{len(indices)} of 200 frames were lost")


def test_where_frames_were_lost():
    warning = only(results_of(changed={k: lost() for k in (30, *range(101, 126))}))
    assert warning.where == "10.0 … 12.6 s"
    assert "for 2.6 s at the longest" in warning.sentence


def test_frames_that_are_left_out_do_not_count_as_lost_too():
    changed = {k: lost() for k in (140, 141)} | {k: lost(DISCONNECTED) for k in range(142, 200)}
    left_out, few = found(results_of(changed=changed))
    assert (left_out.kind, few.kind) == ("left out", "lost")
    assert few.weight == "note"
    assert few.where == "13.9 … 14.2 s"


def test_a_part_that_is_left_out_breaks_a_run():
    changed = {k: lost(DISCONNECTED) for k in range(150, 200)}
    warning = only(results_of(changed=changed))
    assert (warning.kind, warning.weight) == ("left out", "break")
    assert "50 of 200 frames" in warning.sentence


def test_doubtful_frames_and_their_main_reasons():
    jumps = {k: doubted(Doubt("jump", f"jump of 0.{k} m where 0.09 m was predicted")) for k in range(11, 19)}
    some = {k: doubted(Doubt("disagreement", "12 inliers on one side of the image")) for k in range(51, 54)}
    warning = only(results_of(changed=jumps | some))
    assert (warning.kind, warning.weight) == ("doubtful", "doubt")
    assert "11 of 200 placed frames are doubtful, 5.5%, for 0.9 s at the longest" in warning.sentence
    assert "jump of 0.11 m where 0.09 m was predicted (8); 12 inliers on one side of the image (3)" in (
        warning.sentence
    )
    assert warning.where == "1.0 … 1.9 s"
    assert only(results_of(changed={12: doubted(), 51: doubted(), 99: doubted()})).weight == "note"


def test_motions_that_nothing_shows_have_another_remedy_than_settings():
    unseen = doubted(unobservable="translation along x")
    warning = only(results_of(changed=dict.fromkeys(range(11, 23), unseen)))
    assert "wheel odometry" in warning.suggestion

    results = results_of(changed=dict.fromkeys(range(11, 23), unseen), sigmas=PoseSigmas(0.04, 0.05))
    (uncertain,) = found(results, kind="uncertainty")
    assert uncertain.suggestion == warning.suggestion  # not to come back, for loops

    few = dict.fromkeys(range(11, 14), unseen) | {k: doubted() for k in range(20, 30)}
    assert not only(results_of(changed=few)).suggestion


def test_wheels_that_are_in_the_graph_are_not_asked_for():
    unseen = doubted(unobservable="translation along x")
    results = results_of(changed=dict.fromkeys(range(11, 23), unseen))
    T = results.graph.T_world_node
    results.graph.add_factors(
        BetweenFactor(k - 1, k, inverse(T[k - 1]) @ T[k], INFORMATION, "wheel") for k in range(1, 40)
    )
    assert "wheel" not in only(results).suggestion


def test_loops_are_not_asked_for_where_a_path_has_none():
    (warning,) = found(results_of(sigmas=PoseSigmas(0.04, 0.05)), kind="uncertainty")
    assert "loops" not in warning.suggestion


def test_single_repeated_images_do_not_count_but_a_long_repetition_does():
    repeated = doubted(Doubt("repeated image", "same image as 1 frames before"))
    assert only(results_of(changed=dict.fromkeys(range(10, 200, 10), repeated))).weight == "note"
    assert only(results_of(changed=dict.fromkeys(range(100, 125), repeated))).weight == "doubt"


def test_doubtful_frames_for_longer_than_neighbours_hold_a_path():
    assert only(results_of(2000, changed=dict.fromkeys(range(100, 118), doubted()))).weight == "note"
    assert only(results_of(2000, changed=dict.fromkeys(range(100, 125), doubted()))).weight == "doubt"


def test_skipped_frames():
    manifest = MANIFEST.model_copy(
        update={"skipped": tuple(SkippedFrame(stamp_ns=k, reason="7.png: truncated") for k in range(3))}
    )
    assert only(results_of(), manifest).weight == "note"
    many = manifest.model_copy(update={"skipped": manifest.skipped * 10})
    warning = only(results_of(), many)
    assert warning.weight == "doubt"
    assert warning.sentence == "30 of 200 frames could not be read; the first: 7.png: truncated"


def late(first, by_ns, count=200):
    return {k: k * STEP_NS + by_ns for k in range(first, count)}


def test_a_missing_stretch_of_the_log_is_a_gap():
    warning = only(results_of(stamps_ns=late(80, 2_000_000_000)))
    assert (warning.kind, warning.where) == ("gap", "7.9 … 10.0 s")
    assert warning.sentence == "the log has 1 gap, 2.1 s in all, the longest 2.1 s; frames come every 0.1 s"
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
    assert "2.50 m and 0.0° from the odometry, over 5.0 m of path (at most 0.30 m and 10° are usual)" in (
        warning.sentence
    )
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
