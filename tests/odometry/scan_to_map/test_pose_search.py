"""Search of a scan's pose from many guesses, and the choice among what they lead to."""

import numpy as np
import pytest

from mapper.core.geometry import angle_between, exp, inverse
from mapper.odometry.scan_to_map.config import GicpOdometryConfig
from mapper.odometry.scan_to_map.gicp import GicpMatcher
from mapper.odometry.scan_to_map.observed_part import MEASURED
from mapper.odometry.scan_to_map.odometry import ScanOdometry
from mapper.odometry.scan_to_map.pose_candidate import FoundPoses, PoseCandidate, best_of
from mapper.odometry.scan_to_map.pose_search import PoseSearch
from mapper.odometry.scan_to_map.scan_fit import fit_of
from mapper.odometry.scan_to_map.scan_state import ScanState
from mapper.odometry.scan_to_map.usual_fit import Shares, UsualFit, jump_between
from tests.support.room_scans import CRATES, INDOOR, OFF, keyframe, room_scan


class MisledMatcher(GicpMatcher):
    """GICP that is off by 15° and 0.58 m when the predicted pose is used as it is."""

    misled = False

    def match(self, deskewed, T_world_body, *, reach):
        found = super().match(deskewed, T_world_body, reach=reach)
        return found if found is None or not self.misled else found @ OFF


def test_a_wrong_pose_of_the_matcher_is_replaced_by_one_that_fits():
    matcher = MisledMatcher(INDOOR)
    odometry = ScanOdometry(INDOOR, matcher)
    poses = [exp(np.array([0.0, 0.0, 0.02 * k]), np.array([0.1 * k, 0.0, 0.0])) for k in range(12)]
    for k, pose in enumerate(poses):
        matcher.misled = k == 11
        track = odometry.track(odometry.observe(room_scan(k * 500_000_000, pose, seed=k)))

    miss = inverse(poses[-1]) @ track.T_world_body
    assert track.diagnostics.method != "map"
    assert track.doubts == ()
    assert np.linalg.norm(miss[:3, 3]) < 0.05
    assert angle_between(np.eye(3), miss[:3, :3]) < 0.02


@pytest.mark.parametrize("turn_rad", [3.0, 2.7])
def test_a_scan_that_is_turned_and_tilted_beyond_the_other_guesses_is_found(turn_rad):
    odometry = ScanOdometry(INDOOR, GicpMatcher(INDOOR))
    for k in range(8):
        odometry.track(odometry.observe(room_scan(k * 500_000_000, seed=k, more=CRATES)))
    turned = exp(np.array([0.25, 0.0, turn_rad]), np.array([0.7, 0.3, 0.0]))

    track = odometry.track(odometry.observe(room_scan(4_000_000_000, turned, seed=8, more=CRATES)))

    assert track.diagnostics.method == "rescued"
    miss = inverse(turned) @ track.T_world_body
    assert np.linalg.norm(miss[:3, 3]) < 0.05
    assert angle_between(np.eye(3), miss[:3, :3]) < 0.02


def test_a_turn_that_takes_longer_than_the_time_between_two_scans_is_not_found():
    odometry = ScanOdometry(INDOOR, GicpMatcher(INDOOR))
    for k in range(8):
        odometry.track(odometry.observe(room_scan(k * 100_000_000, seed=k, more=CRATES)))
    turned = exp(np.array([0.25, 0.0, 3.0]), np.array([0.7, 0.3, 0.0]))

    track = odometry.track(odometry.observe(room_scan(800_000_000, turned, seed=8, more=CRATES)))

    assert angle_between(np.eye(3), track.T_world_body[:3, :3]) < 4.0 * np.pi * 0.1
    assert track.node is None or track.doubts


class CountingMatcher(GicpMatcher):
    """GICP that counts the guesses it is given."""

    count = 0

    def match(self, deskewed, T_world_body, *, reach):
        self.count += 1
        return super().match(deskewed, T_world_body, reach=reach)


def test_a_search_ends_when_several_guesses_lead_to_one_pose(monkeypatch):
    matcher = CountingMatcher(INDOOR)
    odometry = ScanOdometry(INDOOR, matcher)
    for k in range(8):
        odometry.track(odometry.observe(room_scan(k * 500_000_000, seed=k)))
    monkeypatch.setattr(UsualFit, "agrees_little", lambda *_: True)
    matcher.count = 0
    track = odometry.track(odometry.observe(room_scan(4_000_000_000, seed=8)))

    assert 3 <= matcher.count <= 10  # of 8 guesses, each to the map and to two scans
    assert np.linalg.norm(track.T_world_body[:3, 3]) < 0.02


def test_found_poses_count_the_guesses_that_led_to_them():
    found = FoundPoses(0.2, [np.eye(4)])
    close, far = (exp(np.zeros(3), np.array([x_m, 0.0, 0.0])) for x_m in (0.02, 0.2))
    turned = exp(np.array([0.0, 0.0, 0.05]), np.zeros(3))

    assert not found.add(close, 1)
    assert found.add(far, 1)
    assert found.add(turned, 2)
    assert not found.add(close, 1)
    assert [found.guesses_of(pose) for pose in (np.eye(4), far, turned)] == [2, 1, 1]


@pytest.mark.parametrize(
    ("method", "agreement", "is_doubted"),
    [
        ("rescued", 0.45, True),
        ("rescued", 0.2, False),
        ("map", 0.45, False),
    ],
)
def test_a_pose_that_was_searched_is_a_doubt_if_another_fits_as_well(method, agreement, is_doubted):
    key = keyframe(room_scan(0, seed=1))
    fit = fit_of(key, key.deskewed, np.eye(4), max_pair_distance_m=0.5)
    search = PoseSearch(GicpOdometryConfig(), ScanState(GicpMatcher(GicpOdometryConfig())))

    def candidate(T_world_middle, share):
        jump = jump_between(np.eye(4), T_world_middle, None)
        return PoseCandidate(key, T_world_middle, fit, Shares(0.6, share, 0.0), jump, MEASURED, method)

    there = exp(np.zeros(3), np.array([3.0, 0.0, 0.0]))
    nearly = exp(np.zeros(3), np.array([0.02, 0.0, 0.0]))
    best = best_of(
        [candidate(np.eye(4), 0.5), candidate(nearly, 0.49), candidate(there, agreement)], other_m=0.5
    )

    assert best.second_score == agreement
    assert [doubt.text for doubt in search.doubts(best)] == ["another pose fits as well"] * is_doubted
