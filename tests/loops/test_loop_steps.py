"""Image verification, drift gate, consistency check and the file of loop closures."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mapper.core.errors import DataError, RunError
from mapper.core.geometry import exp, inverse, log, transform
from mapper.graph.model import BetweenFactor, PoseSigmas, Solution
from mapper.graph.noise import with_model_error
from mapper.loops.closure import (
    Discrepancy,
    LoopClosure,
    apply_solution,
    discrepancy,
    exceeds,
    read_closures,
    write_closures,
)
from mapper.loops.config import GateConfig, ImageVerificationConfig
from mapper.loops.consistency_check import ConsistencyCheck
from mapper.loops.image_verification import ImageVerifier
from mapper.loops.odometry_chain import OdometryChain, allowed
from mapper.odometry.config import MatchConfig
from tests.support.feature_room import Room

SURE = PoseSigmas(rotation_rad=0.01, translation_m=0.01).information


def at(x: float, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    T = exp(np.array([0.0, 0.0, yaw]), np.zeros(3))
    T[:2, 3] = [x, y]
    return T


def loop(i: int, j: int, T_i_j: np.ndarray | None = None, **rest) -> LoopClosure:
    T_i_j = np.eye(4) if T_i_j is None else T_i_j
    given = {"verdict": "accepted", "information": SURE, "T_i_j": T_i_j, **rest}
    return LoopClosure(i=i, j=j, stamp_i_ns=i, stamp_j_ns=j, proposed_by="places", **given)


# Verification


def test_two_views_of_one_place_give_their_relative_pose():
    room = Room(1)
    T_world_i, T_world_j = at(0.2, 0.1, 0.1), at(0.5, -0.2, -0.15)
    found = ImageVerifier(ImageVerificationConfig()).verify(room.view(T_world_i, 0), room.view(T_world_j, 1))
    assert found.reason == ""
    miss = discrepancy(found.T_i_j, T_world_i, T_world_j)
    assert miss.translation_m < 0.01
    assert miss.rotation_rad < 0.005
    assert found.inliers > 100
    assert 0.2 < found.residual_px < 2.0


def test_isvd_can_be_the_measure_too():
    room = Room(1)
    views = room.view(at(0.2, 0.1, 0.1), 0), room.view(at(0.4), 1)
    by_isvd = ImageVerifier(ImageVerificationConfig(measure="isvd")).verify(*views)
    by_pixels = ImageVerifier(ImageVerificationConfig()).verify(*views)
    assert by_isvd.reason == by_pixels.reason == ""
    assert not np.array_equal(by_isvd.T_i_j, by_pixels.T_i_j)
    assert discrepancy(by_isvd.T_i_j, np.eye(4), by_pixels.T_i_j).translation_m < 0.02


def test_the_claimed_uncertainty_covers_the_error():
    room, verifier = Room(3), ImageVerifier(ImageVerificationConfig())
    T_world_i = at(0.0)
    chi2 = []
    for k in range(20):
        T_world_j = at(0.01 * k, 0.2, 0.02 * k)
        found = verifier.verify(room.view(T_world_i, 0), room.view(T_world_j, 1))
        twist = np.concatenate(log(inverse(found.T_i_j) @ inverse(T_world_i) @ T_world_j))
        chi2.append(twist @ found.information @ twist)
    assert np.mean(chi2) < 12.0  # six are expected of honest information


def test_views_of_two_rooms_are_not_one_place():
    found = ImageVerifier(ImageVerificationConfig()).verify(
        Room(1).view(at(0.0), 0), Room(2).view(at(0.0), 1)
    )
    assert found.T_i_j is None
    assert found.reason.startswith("matching: ")
    assert "want 45" in found.reason


def test_the_same_things_standing_differently_are_not_one_place():
    room, mixed = Room(1), Room(1)
    mixed.points = np.random.default_rng(5).permutation(mixed.points)
    config = ImageVerificationConfig(min_matches=10)
    found = ImageVerifier(config).verify(room.view(at(0.0), 0), mixed.view(at(0.0), 1))
    assert found.T_i_j is None
    assert found.reason.startswith(("isvd: ", "reprojection: "))


def test_reprojection_refuses_what_isvd_alone_would_take():
    room = Room(1)
    i, j = room.view(at(0.0), 0), room.view(at(0.1), 1)
    shifted = replace(j, pixels=j.pixels + np.random.default_rng(0).normal(0.0, 15.0, j.pixels.shape))
    found = ImageVerifier(ImageVerificationConfig()).verify(i, shifted)
    assert found.reason.startswith("reprojection: ")
    assert found.rmse_m is not None


def test_a_homography_filters_the_pairs_when_asked():
    config = ImageVerificationConfig(match=MatchConfig(filter="homography"), min_matches=45)
    room = Room(1)
    plain = ImageVerifier(ImageVerificationConfig()).verify(room.view(at(0.0), 0), room.view(at(0.3, 0.2), 1))
    filtered = ImageVerifier(config).verify(room.view(at(0.0), 0), room.view(at(0.3, 0.2), 1))
    assert filtered.matches < plain.matches


def test_model_errors_grow_with_the_distance_between_the_views():
    tight = np.eye(6) * 1e8
    near, far = with_model_error(tight, at(0.1)), with_model_error(tight, at(2.0))
    assert np.linalg.inv(far)[3, 3] ** 0.5 == pytest.approx(0.041, rel=0.01)
    assert np.linalg.inv(near)[3, 3] < np.linalg.inv(far)[3, 3]
    loose = np.eye(6)
    np.testing.assert_allclose(with_model_error(loose, at(0.1)), loose, rtol=1e-3)


# Drift


def steps(length: int) -> list[BetweenFactor]:
    return [BetweenFactor(k, k + 1, at(1.0, 0.0, 0.1), SURE) for k in range(length)]


def test_the_path_between_two_nodes_is_as_long_as_its_steps():
    chain = OdometryChain()
    chain.add(steps(10))
    path = chain.between(2, 9).path
    assert path.path_m == pytest.approx(7.0)
    assert path.turned_rad == pytest.approx(0.7)
    assert chain.between(9, 2).path == path


def test_a_loop_shortens_every_path_over_it():
    chain = OdometryChain()
    chain.add(steps(10))
    chain.add([BetweenFactor(0, 10, at(0.1), SURE, "loop")])
    assert chain.between(1, 9).path.path_m == pytest.approx(2.1)


def test_disconnected_nodes_have_no_path():
    chain = OdometryChain()
    chain.add(steps(3))
    chain.add([BetweenFactor(20, 21, at(1.0), SURE)])
    assert chain.between(0, 21) is None


def test_connected_nodes_are_those_with_a_path():
    chain = OdometryChain()
    assert chain.connected(3, [3, 4]).tolist() == [True, False]
    chain.add(steps(3))
    chain.add([BetweenFactor(20, 21, at(1.0), SURE)])
    assert chain.connected(0, [3, 20, 21, 40]).tolist() == [True, False, False, False]
    assert chain.connected(40, []).tolist() == []
    chain.add([BetweenFactor(21, 2, at(1.0), SURE, "loop")])
    assert chain.connected(0, [3, 20, 21, 40]).tolist() == [True, True, True, False]


@pytest.mark.parametrize("edges", [100, 1500, 4000])
def test_parts_may_grow_together_in_any_order(edges):
    rng = np.random.default_rng(edges)
    ends = np.array([rng.choice(3000, 2, replace=False) for _ in range(edges)])
    chain = OdometryChain()
    for i, j in ends.tolist():
        chain.add([BetweenFactor(i, j, at(1.0), SURE)])
    _, labels = connected_components(coo_array((np.ones(edges), tuple(ends.T)), shape=(3000, 3000)))
    for node in rng.integers(0, 3000, 20).tolist():
        assert chain.connected(node, range(3000)).tolist() == (labels == labels[node]).tolist()


def test_around_a_node_lie_those_within_reach():
    chain = OdometryChain()
    chain.add(steps(10))
    assert sorted(chain.around(5, within_m=2.0)) == [3, 4, 5, 6, 7]


def test_the_gate_widens_with_the_path():
    chain = OdometryChain()
    chain.add(steps(40))
    gate = GateConfig()
    near, far = (allowed(gate, chain.between(0, node).path) for node in (1, 40))
    assert far.translation_m == pytest.approx(gate.slack_m + gate.drift_ratio * 40.0)
    assert far.rotation_rad > near.rotation_rad
    assert exceeds(Discrepancy(1.0, 0.0), near)
    assert not exceeds(Discrepancy(1.0, 0.0), far)
    assert exceeds(Discrepancy(0.0, 3.0), far)


# Consistency check


class FixedPoses:
    """An estimator whose poses no loop changes."""

    def __init__(self, poses: dict[int, np.ndarray]) -> None:
        self._poses = poses

    def pose_of(self, node: int) -> np.ndarray:
        return self._poses[node]


@pytest.fixture
def check():
    """Nodes 0 … 40 on a line, a metre apart; one other must agree."""
    chain = OdometryChain()
    chain.add([BetweenFactor(k, k + 1, at(1.0), SURE) for k in range(40)])
    estimator = FixedPoses({k: at(float(k)) for k in range(41)})
    return ConsistencyCheck(chain, estimator, GateConfig(), min_agreeing=1, within_m=3.0)


def test_a_lone_loop_waits_until_another_agrees(check):
    first, second = loop(2, 30, at(0.5)), loop(3, 31, at(0.5))
    assert check.add(first) == []
    assert check.add(second) == [first, second]


def test_a_loop_that_disagrees_is_no_support(check):
    assert check.add(loop(2, 30, at(0.5))) == []
    assert check.add(loop(3, 31, at(2.5))) == []


def test_another_loop_of_the_same_keyframe_is_no_support(check):
    assert check.add(loop(2, 30, at(0.5))) == []
    assert check.add(loop(3, 30, at(-0.5))) == []


def test_a_loop_far_along_the_path_is_no_support(check):
    assert check.add(loop(2, 30, at(0.5))) == []
    assert check.add(loop(12, 40, at(0.5))) == []


def test_a_third_loop_joins_those_confirmed(check):
    check.add(loop(2, 30, at(0.5)))
    check.add(loop(3, 31, at(0.5)))
    third = loop(4, 32, at(0.5))
    assert check.add(third) == [third]


# Closures


def test_the_file_of_closures_comes_back_whole(tmp_path):
    path = tmp_path / "loops.jsonl"
    accepted = loop(
        1,
        5,
        at(0.3, 0.2, 0.7),
        similarity=0.41,
        matches=80,
        inliers=60,
        rmse_m=0.01,
        residual_px=0.8,
        before=Discrepancy(0.2, 0.01),
        after=Discrepancy(0.01, 0.001),
        weight=1.0,
    )
    refused = loop(2, 6, verdict="rejected", reason="isvd: 3 pairs", information=None, T_i_j=None)
    refused = replace(refused, T_i_j=None)
    write_closures(path, [accepted, refused])
    first, second = read_closures(path)
    np.testing.assert_allclose(first.T_i_j, accepted.T_i_j, atol=1e-12)
    np.testing.assert_array_equal(first.information, accepted.information)
    assert (first.before, first.after, first.similarity) == (
        accepted.before,
        accepted.after,
        accepted.similarity,
    )
    assert (second.verdict, second.reason, second.T_i_j) == ("rejected", "isvd: 3 pairs", None)


def test_a_damaged_line_is_named(tmp_path):
    path = tmp_path / "loops.jsonl"
    write_closures(path, [loop(1, 5)])
    path.write_text(path.read_text() + '{"i": 3}\n')
    with pytest.raises(DataError, match=r"loops\.jsonl:2: not a loop closure"):
        read_closures(path)
    with pytest.raises(RunError, match="cannot be read"):
        read_closures(tmp_path / "none.jsonl")


def test_a_verdict_fits_its_reason():
    with pytest.raises(DataError, match="a rejected loop says why"):
        loop(1, 2, verdict="rejected")
    with pytest.raises(DataError, match="a rejected loop says why"):
        loop(1, 2, reason="alone: …")
    with pytest.raises(DataError, match="without a measurement"):
        loop(1, 2, information=None)


def test_loops_that_the_solver_lets_go_are_rejected():
    before = {0: at(0.0), 1: at(1.0), 2: at(2.0)}
    loops = [
        loop(0, 1, at(1.1)),
        loop(0, 2, verdict="rejected", reason="alone: no", information=None),
        loop(0, 2, at(5.0)),
    ]
    solved = Solution({0: at(0.0), 1: at(1.1), 2: at(2.0)}, 1, (0.0,) * 3, (0.0,) * 3, (1.0, 0.9, 0.02))
    kept, alone, refused = apply_solution(loops, before, solved, min_weight=0.5)
    assert kept.verdict == "accepted"
    assert kept.before.translation_m == pytest.approx(0.1)
    assert kept.after.translation_m == pytest.approx(0.0, abs=1e-9)
    assert kept.weight == 0.9
    assert alone is loops[1]
    assert (refused.verdict, refused.weight) == ("rejected", 0.02)
    assert refused.reason.startswith("solver: ")


def test_the_constraint_is_a_loop():
    assert loop(1, 5).factor.origin == "loop"
    with pytest.raises(DataError, match="nothing was measured"):
        _ = replace(loop(1, 5, verdict="rejected", reason="x: y"), T_i_j=None).factor


def test_discrepancy_is_zero_where_the_loop_holds():
    T_i = transform(exp(np.array([0.1, 0.2, 0.3]), np.zeros(3))[:3, :3], np.array([1.0, 2.0, 3.0]))
    T_i_j = at(0.5, 0.2, 0.3)
    assert discrepancy(T_i_j, T_i, T_i @ T_i_j).translation_m == pytest.approx(0.0, abs=1e-12)
