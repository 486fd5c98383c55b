"""Loops found on a walk round a made-up room: by words, by pose, and as the thesis does."""

from collections.abc import Sequence
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import DataError
from mapper.core.geometry import Transform, exp, inverse
from mapper.core.timebase import NS_PER_S
from mapper.features.frame_view import ImageView
from mapper.graph.model import BetweenFactor, PoseSigmas
from mapper.loops.closure import LoopClosure, discrepancy
from mapper.loops.config import GateConfig, NoLoopsConfig, PlaceLoopsConfig, ThesisLoopsConfig
from mapper.loops.detector import LoopDetector
from mapper.loops.factory import build_loop_detector
from tests.support.feature_room import LAP, LINK, NODES, PLACES, Room, track, walked


def drifting(truth: Sequence[Transform]) -> list[Transform]:
    """The same walk by an odometry that turns 1 % too far and climbs a little."""
    poses = [truth[0]]
    for before, after in pairwise(truth):
        step = inverse(before) @ after @ exp(np.array([0.0, 0.0, 0.0015]), np.array([0.0, 0.0, 0.004]))
        poses.append(poses[-1] @ step)
    return poses


def walk(
    detector: LoopDetector,
    room: Room,
    *,
    poses: Sequence[Transform] | None = None,
    features=None,
    information=LINK,
) -> list[ImageView]:
    """Feed a loop detector with the walk; ``poses`` are the odometry's, ``information`` that of its steps."""
    truth = walked()
    poses = drifting(truth) if poses is None else poses
    views = [room.view(T, k * NS_PER_S // 2) for k, T in enumerate(truth)]
    for k, T_world_body in enumerate(poses):
        links = [BetweenFactor(k - 1, k, inverse(poses[k - 1]) @ T_world_body, information)] if k else []
        count = 500 if features is None else features[k]
        detector.add(
            k, track(k, views[k].stamp_ns, T_world_body, links, features=count), partial(views.__getitem__, k)
        )
    return views


def accepted(detector: LoopDetector) -> list[LoopClosure]:
    return [loop for loop in detector.closures() if loop.verdict == "accepted"]


def worst_m(loops: Sequence[LoopClosure]) -> float:
    truth = walked()
    return max(discrepancy(loop.T_i_j, truth[loop.i], truth[loop.j]).translation_m for loop in loops)


@pytest.mark.parametrize("propose", ["places", "nearby"])
def test_the_second_lap_closes_on_the_first(propose):
    detector = build_loop_detector(PlaceLoopsConfig(propose=propose, places=PLACES), "batch")
    walk(detector, Room(1))
    found = accepted(detector)
    assert len({loop.j for loop in found}) >= 0.8 * (NODES - LAP)
    assert worst_m(found) < 0.05
    assert {loop.proposed_by for loop in found} == {propose}
    assert min(loop.stamp_j_ns - loop.stamp_i_ns for loop in detector.closures()) >= 5 * NS_PER_S


def test_loops_correct_the_current_estimate():
    detector = build_loop_detector(PlaceLoopsConfig(places=PLACES), "batch")
    walk(detector, Room(1))
    truth = walked()
    drifted = drifting(truth)
    end = detector.current_estimate(NODES - 1)
    assert np.linalg.norm(drifted[-1][:3, 3] - truth[-1][:3, 3]) > 0.1
    assert np.linalg.norm(end[:3, 3] - truth[-1][:3, 3]) < 0.05


def test_two_runs_find_the_same():
    runs = []
    for _ in range(2):
        detector = build_loop_detector(PlaceLoopsConfig(places=PLACES), "batch")
        walk(detector, Room(1))
        runs.append([(loop.i, loop.j, loop.reason, loop.similarity) for loop in detector.closures()])
    assert runs[0] == runs[1]


TIGHT = GateConfig(slack_m=0.01, drift_ratio=0.0, drift_rad_per_m=0.0)


@pytest.mark.parametrize(
    ("changes", "step"),
    [
        ({"gate": TIGHT}, "gate"),
        ({"min_agreeing": NODES}, "unconfirmed"),
        ({"agreement_path_m": 0.01}, "unconfirmed"),
        ({"min_motion_m": 10.0, "min_motion_rad": 10.0}, None),
    ],
    ids=["gate", "confirmed by too few", "too far along the path", "without motion"],
)
def test_each_condition_alone_rejects_all_loops(changes, step):
    detector = build_loop_detector(PlaceLoopsConfig(places=PLACES, **changes), "batch")
    sure = PoseSigmas(rotation_rad=1e-5, translation_m=1e-5).information
    walk(detector, Room(1), information=sure if step == "gate" else LINK)
    assert not accepted(detector)
    assert any(loop.rejected_by == step for loop in detector.closures()) == (step is not None)
    assert bool(detector.closures()) == (step is not None)


def test_words_need_orb_descriptors():
    detector = build_loop_detector(PlaceLoopsConfig(propose="places"), "batch")
    view = Room(1).view(np.eye(4), 0)
    numbers = ImageView(
        0,
        view.pixels,
        view.sigma_px,
        np.zeros((len(view), 64), np.float32),
        view.points_camera,
        view.intrinsics,
        view.T_body_camera,
    )
    with pytest.raises(DataError, match="want 256 bits; choose detector 'orb' or 'uniform-orb'"):
        detector.add(0, track(0, 0, np.eye(4)), lambda: numbers)


def test_the_thesis_looks_only_from_sharp_frames():
    sharp = [800 if k % 10 == 5 else 500 for k in range(NODES)]
    detector = build_loop_detector(ThesisLoopsConfig(keyframe_interval=5), "proportional")
    walk(detector, Room(1), features=sharp)
    assert detector.closures()
    assert {loop.j % 10 for loop in detector.closures()} == {5}
    assert worst_m(accepted(detector)) < 0.05


def test_sharpness_is_relative_to_the_last_frames():
    features = [500 if k < 30 else 800 for k in range(NODES)]  # the texture changes for good
    detector = build_loop_detector(ThesisLoopsConfig(keyframe_interval=5), "proportional")
    walk(detector, Room(1), features=features)
    assert max((loop.j for loop in detector.closures()), default=0) < 33


def test_the_thesis_finds_nothing_when_no_frame_is_sharp():
    detector = build_loop_detector(ThesisLoopsConfig(), "proportional")
    walk(detector, Room(1))
    assert not detector.closures()


def test_proportional_correction_puts_the_newest_node_where_its_loop_wants_it():
    sharp = [800 if k == 50 else 500 for k in range(NODES)]
    detector = build_loop_detector(ThesisLoopsConfig(keyframe_interval=5), "proportional")
    walk(detector, Room(1), features=sharp)
    (closed,) = accepted(detector)
    assert closed.j == 50
    miss = discrepancy(closed.T_i_j, detector.current_estimate(closed.i), detector.current_estimate(closed.j))
    assert miss.translation_m == pytest.approx(0.0, abs=1e-9)


def test_the_configuration_names_the_kind_and_none_finds_nothing():
    assert isinstance(load_config(None, ["loops.kind=thesis"]).loops, ThesisLoopsConfig)
    assert isinstance(load_config().loops, PlaceLoopsConfig)
    none = load_config(None, ["loops.kind=none"]).loops
    assert isinstance(none, NoLoopsConfig)
    detector = build_loop_detector(none, "batch")
    walk(detector, Room(1))
    assert detector.closures() == ()
