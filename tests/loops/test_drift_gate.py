"""Two rooms furnished alike: loops between them are rejected by wheels and odometry, and reported."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest

from mapper.core.geometry import Transform, exp, inverse, log, transform
from mapper.core.timebase import NS_PER_S
from mapper.graph.drift import innovations
from mapper.graph.model import BetweenFactor, PoseSigmas
from mapper.loops.closure import LoopClosure
from mapper.loops.config import PlaceLoopsConfig
from mapper.loops.detector import KeyframeLoopDetector
from mapper.loops.factory import build_keyframe_loop_detector
from mapper.loops.odometry_drift import OdometryChain
from tests.support.feature_room import LAP, LINK, NODES, PLACES, Room, track, walked

SURE = PoseSigmas(rotation_rad=0.001, translation_m=0.002).information
WHEELS = PoseSigmas(rotation_rad=0.2, translation_m=0.5).information
"""After ten metres."""
TEN_METRES_ON = transform(np.eye(3), [10.0, 0.0, 0.0])


def moved(offset: Transform, connection: tuple[np.ndarray, str] | None) -> KeyframeLoopDetector:
    """Walk a lap through a room, and half of one through a room alike, elsewhere.

    Args:
        offset: Where the odometry believes the second room to be, relative to the first.
        connection: Information and origin of the link between the two; None if nothing connects them.
    """
    detector = build_keyframe_loop_detector(PlaceLoopsConfig(places=PLACES), "batch")
    room, truth = Room(1), walked()
    believed = [T if k < LAP else offset @ T for k, T in enumerate(truth)]
    views = [room.view(T, k * NS_PER_S // 2) for k, T in enumerate(truth)]
    for k, T in enumerate(believed):
        links = []
        if k and k != LAP:
            links = [BetweenFactor(k - 1, k, inverse(believed[k - 1]) @ T, LINK)]
        elif k and connection:
            links = [BetweenFactor(k - 1, k, inverse(believed[k - 1]) @ T, *connection)]
        detector.add(k, track(k, views[k].stamp_ns, T, links), partial(views.__getitem__, k))
    return detector


def between_rooms(detector: KeyframeLoopDetector) -> list[LoopClosure]:
    return [loop for loop in detector.closures() if loop.i < LAP <= loop.j and loop.T_i_j is not None]


def accepted(loops: Sequence[LoopClosure]) -> list[LoopClosure]:
    return [loop for loop in loops if loop.verdict == "accepted"]


def test_wheels_reject_loops_between_two_rooms_alike_and_say_so():
    detector = moved(TEN_METRES_ON, (WHEELS, "wheel"))
    loops = between_rooms(detector)
    assert len(loops) > 10
    assert not accepted(loops)
    for loop in loops:
        assert loop.reason.startswith("gate: 10.")
        assert loop.reason.endswith("m of path by wheels and odometry")
    (note,) = detector.notes()
    count = int(note.split()[0])
    assert 10 < count <= len(loops)
    assert "agree with each other but not with the wheels: median 10." in note


def test_without_wheels_nothing_tells_them_apart():
    detector = moved(TEN_METRES_ON, None)
    assert len({loop.j for loop in accepted(between_rooms(detector))}) > 0.7 * (NODES - LAP)
    assert detector.notes() == []


def test_wheels_that_lead_back_to_the_same_room_let_its_loops_pass():
    aside = exp(np.array([0.0, 0.0, 0.2]), np.array([0.7, -0.5, 0.0]))  # the wheels' error on the way
    detector = moved(aside, (WHEELS, "wheel"))
    assert len({loop.j for loop in accepted(between_rooms(detector))}) > 0.7 * (NODES - LAP)
    assert detector.notes() == []
    end = detector.current_estimate(NODES - 1)
    assert np.linalg.norm(end[:3, 3] - walked()[-1][:3, 3]) < 0.1


def test_odometry_along_a_corridor_rejects_them_too():
    detector = moved(TEN_METRES_ON, (LINK, "odometry"))
    assert not accepted(between_rooms(detector))
    (note,) = detector.notes()
    assert "agree with each other but not with the odometry: median 10." in note


@pytest.mark.parametrize(("sigma_m", "hold"), [(0.01, False), (0.6, True)])
def test_a_doubtful_step_may_be_corrected_by_more(sigma_m, hold):
    """The odometry jumps by 1.5 m in one step; only if it says so itself, loops may mend that."""
    information = PoseSigmas(rotation_rad=0.02, translation_m=sigma_m).information
    detector = moved(transform(np.eye(3), [1.5, 0.0, 0.0]), (information, "odometry"))
    assert bool(accepted(between_rooms(detector))) is hold
    assert bool(detector.notes()) is not hold


def chain_of(factors: Sequence[BetweenFactor]) -> OdometryChain:
    chain = OdometryChain()
    chain.add(factors)
    return chain


@pytest.mark.parametrize("start", [0, 12])
def test_the_covariance_of_a_path_is_that_of_its_steps(start):
    """Held against the innovations of the batch solve, which add up the same steps in another frame."""
    rng = np.random.default_rng(2)
    steps = []
    for k in range(12):
        root = rng.normal(0.0, 0.01, (6, 6))
        T = exp(rng.normal(0, 0.3, 3), rng.normal(0, 0.5, 3))
        steps.append(BetweenFactor(k, k + 1, T, np.linalg.inv(root @ root.T + 1e-6 * np.eye(6))))
    end = 12 - start
    T_start_end = np.eye(4)
    for step in steps:
        T_start_end = T_start_end @ step.T_i_j
    T_start_end = T_start_end if start == 0 else inverse(T_start_end)
    miss = exp(rng.normal(0, 0.01, 3), rng.normal(0, 0.01, 3))
    loop = BetweenFactor(start, end, T_start_end @ miss, 1e8 * np.eye(6), "loop")

    drift = chain_of(steps).between(start, end)

    twist = np.concatenate(log(inverse(loop.T_i_j) @ T_start_end))
    chi2 = twist @ np.linalg.solve(drift.covariance + 1e-8 * np.eye(6), twist)
    assert not drift.by_wheels
    assert chi2 == pytest.approx(float(innovations(steps, [loop])[0]), rel=0.02)


def test_a_doubtful_step_is_avoided_where_wheels_know_better():
    doubtful = BetweenFactor(0, 1, np.eye(4), PoseSigmas(rotation_rad=0.4, translation_m=0.9).information)
    driven = BetweenFactor(0, 1, np.eye(4), PoseSigmas(0.01, 0.02).information, "wheel")
    for factors in ((doubtful, driven), (driven, doubtful)):
        drift = chain_of(factors).between(0, 1)
        assert drift.by_wheels
        assert drift.covariance[3:, 3:] == pytest.approx(0.02**2 * np.eye(3))


def test_a_motion_that_surfaces_leave_open_is_still_known_roughly():
    tunnel = np.diag([1e6, 1e6, 1e6, 1e-9, 1e6, 1e6])
    covariance = chain_of([BetweenFactor(0, 1, TEN_METRES_ON, tunnel)]).between(0, 1).covariance
    assert covariance[3, 3] == pytest.approx(1.0)
    assert covariance[4, 4] < 1e-5
