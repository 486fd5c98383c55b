"""Doubts and repeated search of the LiDAR odometries."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.doubts import doubts_text
from mapper.core.frames import Scan
from mapper.core.geometry import apply, exp, inverse
from mapper.odometry.scan_to_map.config import GicpOdometryConfig
from mapper.odometry.scan_to_map.gicp import GicpMatcher
from mapper.odometry.scan_to_map.motion_model import MotionModel, Spread
from mapper.odometry.scan_to_map.observed_part import MEASURED, observed_part
from mapper.odometry.scan_to_map.odometry import ScanOdometry
from mapper.odometry.scan_to_map.pose_candidate import PoseCandidate
from mapper.odometry.scan_to_map.pose_search import PoseSearch
from mapper.odometry.scan_to_map.scan_fit import contradiction, described, fit_of
from mapper.odometry.scan_to_map.scan_state import ScanState
from mapper.odometry.scan_to_map.usual_fit import Shares, UsualFit, jump_between
from tests.support.room_scans import CRATES, INDOOR, OFF, keyframe, room_scan


def tunnel_scan(stamp_ns, x_m, *, seed=0):
    rng = np.random.default_rng(seed)
    along, angle = rng.uniform(-25.0, 25.0, 12000), rng.uniform(0.0, 2.0 * np.pi, 12000)
    corners = np.clip(np.stack([np.cos(angle), np.sin(angle)]) * 2.0, -1.0, 1.0) * [[2.0], [1.5]]
    points = np.column_stack([along, *corners]) + rng.normal(0.0, 0.01, (12000, 3))
    if x_m < 20.0:  # piers that stick out of the wall, not to be seen from farther on
        for pier_m in (-15.0, -10.0, -5.0, 0.0, 5.0, 10.0, 15.0):
            pier = rng.uniform([0.0, 0.8, -1.5], [0.0, 2.0, 1.5], (400, 3)) + rng.normal(0.0, 0.01, (400, 3))
            points = np.concatenate([points, pier + np.array([pier_m - x_m, 0.0, 0.0])])
    return Scan(stamp_ns, points.astype(np.float32))


def test_scans_that_fit_are_not_doubted_and_all_have_a_covariance():
    odometry = ScanOdometry(INDOOR, GicpMatcher(INDOOR))
    poses = [exp(np.array([0.0, 0.0, 0.1 * k]), np.array([0.1 * k, 0.02 * k, 0.0])) for k in range(12)]
    tracks = [
        odometry.track(odometry.observe(room_scan(k * 500_000_000, pose, seed=k)))
        for k, pose in enumerate(poses)
    ]

    assert [track.doubts for track in tracks] == [()] * len(tracks)
    assert {track.diagnostics.method for track in tracks[1:]} == {"map"}
    for track in tracks[1:]:
        assert np.linalg.eigvalsh(track.covariance).min() > 0.0
        assert np.sqrt(np.diag(track.covariance))[3:].max() < 0.05
        for factor in track.factors:
            np.testing.assert_allclose(np.linalg.inv(factor.information), track.covariance, rtol=1e-6)


def test_a_strange_scan_is_not_tracked_and_does_not_enter_the_map():
    odometry = ScanOdometry(INDOOR, GicpMatcher(INDOOR))
    for k in range(8):
        odometry.track(odometry.observe(room_scan(k * 500_000_000, seed=k)))
    strange = room_scan(4_000_000_000, seed=9).points_body * np.array([1.5, 0.5, 1.0], np.float32)
    odd = odometry.track(odometry.observe(Scan(4_000_000_000, strange)))
    after = odometry.track(odometry.observe(room_scan(4_500_000_000, seed=10)))

    assert odd.node is None or odd.doubts
    assert after.doubts == ()
    assert np.linalg.norm(after.T_world_body[:3, 3]) < 0.02


def test_tracking_goes_on_from_a_doubtful_keyframe_that_the_next_scan_fits():
    config = INDOOR.model_copy(update={"keyframe_distance_m": 0.2})
    odometry = ScanOdometry(config, GicpMatcher(config))
    poses = [exp(np.array([0.0, 0.0, 0.01 * k]), np.array([0.25 * (k - 6), 0.0, 0.0])) for k in range(12)]
    tracks = []
    for k, pose in enumerate(poses):
        scan = room_scan(k * 500_000_000, pose, seed=k, points=20000, more=CRATES if k >= 8 else ())
        tracks.append(odometry.track(odometry.observe(scan)))

    assert [bool(track.doubts) for track in tracks] == [k == 8 for k in range(12)]
    assert tracks[9].factors[0].i == tracks[8].node
    miss = inverse(inverse(poses[0]) @ poses[-1]) @ tracks[-1].T_world_body
    assert np.linalg.norm(miss[:3, 3]) < 0.05


def test_what_a_tunnel_does_not_show_is_predicted_and_doubted():
    odometry = ScanOdometry(GicpOdometryConfig(), GicpMatcher(GicpOdometryConfig()))
    places_m = [-5.0 + 0.5 * k for k in range(75)]  # the piers are out of sight from 20 m on
    tracks = [
        odometry.track(odometry.observe(tunnel_scan(k * 100_000_000, x_m, seed=k)))
        for k, x_m in enumerate(places_m)
    ]

    blind, clear = tracks[56:], tracks[10:40]
    assert all("translation along x" in track.diagnostics.unobservable for track in blind)
    assert all(any("predicted" in doubt.text for doubt in track.doubts) for track in blind[3:])
    assert not any(track.doubts for track in clear)
    travelled_m = tracks[-1].T_world_body[0, 3] - tracks[40].T_world_body[0, 3]
    assert travelled_m == pytest.approx(places_m[-1] - places_m[40], abs=1.0)
    sigmas_m = [np.sqrt(track.covariance[3, 3]) for track in (blind[-1], clear[-1])]
    assert sigmas_m[0] > 3.0 * sigmas_m[1]
    assert np.sqrt(blind[-1].covariance[4, 4]) < 0.05


def test_unusual_shares():
    usual = UsualFit()
    for k in range(20):
        usual.add(Shares(0.98 - 0.002 * (k % 3), 0.9, 0.001))

    assert usual.has_little_overlap(Shares(0.56, 0.5, 0.0), usual_ratio=0.8)
    assert not usual.has_little_overlap(Shares(0.85, 0.8, 0.0), usual_ratio=0.8)
    assert usual.contradicts(Shares(0.9, 0.9, 0.05))
    assert not usual.contradicts(Shares(0.9, 0.9, 0.008))
    assert usual.disagrees(Shares(0.9, 0.3, 0.0))
    usual.clear()
    assert not usual.has_little_overlap(Shares(0.82, 0.5, 0.0), usual_ratio=0.8)


def test_the_spread_of_predictions_is_the_logs_own():
    rng = np.random.default_rng(1)
    motion = MotionModel(0, np.eye(4))
    assert motion.spread(100_000_000) is None
    x_m = 0.0
    for k in range(1, 60):
        x_m += 0.1 + rng.normal(0.0, 0.03)
        motion.follow(k * 100_000_000, exp(np.zeros(3), np.array([x_m, 0.0, 0.0])))

    spread = motion.spread(6_000_000_000)

    # The difference of two steps has a median length of 0.67 · √2 · 0.03 m, of three equal axes 1.54 σ.
    assert spread.translation_m == pytest.approx(0.0185, rel=0.4)
    assert spread.rotation_rad == pytest.approx(1e-3, rel=0.1)
    near, far = (exp(np.zeros(3), np.array([off, 0.0, 0.0])) for off in (0.1, 0.3))
    assert not jump_between(np.eye(4), near, spread).is_unusual
    assert jump_between(np.eye(4), far, spread).is_unusual
    assert "0.30 m" in jump_between(np.eye(4), far, spread).text


def dusty_scan(stamp_ns, T_world_body=None, *, seed, one_in):
    """Return a scan of the room of which one return in so many is from dust in the air."""
    scan = room_scan(stamp_ns, T_world_body, seed=seed, points=30000)
    rng = np.random.default_rng(1000 + seed)
    dust = rng.choice(len(scan.points_body), len(scan.points_body) // one_in, replace=False)
    points = scan.points_body.copy()
    points[dust] *= rng.uniform(0.2, 0.9, (len(dust), 1)).astype(np.float32)
    return Scan(stamp_ns, points)


def test_dust_does_not_contradict_a_right_pose_and_a_wrong_one_is_still_contradicted():
    key = keyframe(dusty_scan(0, seed=1, one_in=200))
    other = keyframe(dusty_scan(0, OFF, seed=2, one_in=200))
    assert contradiction(key, other.description, OFF) < 0.006
    assert contradiction(key, other.description, np.eye(4)) > 0.03


def test_a_dusty_log_is_tracked_without_doubt():
    odometry = ScanOdometry(INDOOR, GicpMatcher(INDOOR))
    poses = [exp(np.array([0.0, 0.0, 0.02 * k]), np.array([0.05 * k, 0.0, 0.0])) for k in range(5)]
    scans = [dusty_scan(round(1e8) * k, T, seed=k, one_in=70) for k, T in enumerate(poses)]
    tracks = [odometry.track(odometry.observe(scan)) for scan in scans]
    assert not any(track.doubts for track in tracks)
    assert np.linalg.norm(tracks[-1].T_world_body[:3, 3] - poses[-1][:3, 3]) < 0.02


def test_a_log_in_rain_is_tracked_once_its_first_scans_have_told_what_is_usual():
    odometry = ScanOdometry(INDOOR, GicpMatcher(INDOOR))
    poses = [exp(np.array([0.0, 0.0, 0.02 * k]), np.array([0.1 * k, 0.0, 0.0])) for k in range(12)]
    scans = [dusty_scan(round(1e8) * k, T, seed=k, one_in=10) for k, T in enumerate(poses)]
    tracks = [odometry.track(odometry.observe(scan)) for scan in scans]

    doubtful = [bool(track.doubts) for track in tracks]
    assert doubtful == [False, True, True, True, *[False] * 8]
    assert "where earlier rays passed" in tracks[1].doubts[0].text
    assert np.linalg.norm(tracks[-1].T_world_body[:3, 3] - poses[-1][:3, 3]) < 0.04


@pytest.mark.parametrize(
    ("shares", "contradicting", "is_usual"),
    [
        ((0.9, 0.6), (0.05, 0.06, 0.055), True),
        ((0.9, 0.6), (0.05, 0.06), False),  # too few
        ((0.9, 0.6), (0.05, 0.06, 0.08), False),  # not alike
        ((0.9, 0.6), (0.05, 0.06, 0.005, 0.055), False),  # not in a row
        ((0.6, 0.6), (0.05, 0.06, 0.055), False),  # little overlap
        ((0.9, 0.3), (0.05, 0.06, 0.055), False),  # a direction disagrees
    ],
)
def test_what_all_first_scans_contradict_alike_is_usual(shares, contradicting, is_usual):
    usual = UsualFit()
    for share in contradicting:
        usual.add_doubtful(Shares(*shares, contradicting=share))
    assert usual.contradicts(Shares(*shares, contradicting=0.06)) != is_usual


def test_later_contradictions_are_not_usual():
    usual = UsualFit()
    usual.add(Shares(0.9, 0.6, 0.0))
    for _ in range(5):
        usual.add_doubtful(Shares(0.9, 0.6, 0.05))
    assert usual.contradicts(Shares(0.9, 0.6, 0.05))


def test_a_wrong_pose_contradicts_free_space():
    here, there = room_scan(0, seed=1, points=30000), room_scan(1, OFF, seed=2, points=30000)
    key, description = keyframe(here), described(keyframe(there).deskewed)

    assert contradiction(key, description, OFF) < 0.02
    assert contradiction(key, description, np.eye(4)) > 0.03


def test_a_scan_is_right_when_the_half_of_the_view_that_was_missing_returns():
    config = INDOOR.model_copy(update={"keyframe_distance_m": 0.2})
    odometry = ScanOdometry(config, GicpMatcher(config))
    for k in range(23):
        pose = exp(np.array([0.0, 0.0, 0.02 * k]), np.array([0.1 * k, 0.0, 0.0]))
        scan = room_scan(k * 100_000_000, pose, seed=k)
        if 6 <= k < 22:  # until all keyframes that scans are compared with are halves
            scan = replace(scan, points_body=scan.points_body[scan.points_body[:, 1] > 0.0])
        track = odometry.track(odometry.observe(scan))

        assert track.doubts == ()
        assert k == 0 or track.diagnostics.method == "map"


def field_scan(x_m):
    """Return rings on flat ground 1.7 m below, and four round bushes, from x metres along."""
    azimuth = np.linspace(-np.pi, np.pi, 900, endpoint=False)
    rings = []
    for angle in np.radians(np.arange(-15.0, 15.1, 2.0)):
        distances = np.full(900, 1.7 / np.tan(-angle) if angle < 0.0 else 99.0)
        for bush in ([6.0, 5.0], [-4.0, 8.0], [3.0, -7.0], [-9.0, -6.0]):
            x, y = bush[0] - x_m, bush[1]
            along = x * np.cos(azimuth) + y * np.sin(azimuth)
            depth = 1.2**2 - (x * np.sin(azimuth) - y * np.cos(azimuth)) ** 2
            is_hit = (depth > 0.0) & (along > 0.0)
            distances[is_hit] = np.minimum(distances, along - np.sqrt(np.maximum(depth, 0.0)))[is_hit]
        seen = distances < 40.0
        flat = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(900, np.tan(angle))], axis=1)
        rings.append(flat[seen] * distances[seen, None])
    points = np.concatenate(rings)
    return Scan(0, (points + np.random.default_rng(0).normal(0.0, 0.01, points.shape)).astype(np.float32))


@pytest.mark.parametrize(("moved_m", "is_shown"), [(1.0, True), (0.1, False)])
def test_a_few_bushes_in_a_field_show_a_motion_of_more_than_a_voxel(moved_m, is_shown):
    key = keyframe(field_scan(0.0), voxel_m=0.4)
    scan = keyframe(field_scan(moved_m), voxel_m=0.4).deskewed
    right = exp(np.zeros(3), np.array([moved_m, 0.0, 0.0]))

    fit = fit_of(key, scan, right, max_pair_distance_m=0.5)

    assert fit.contradicting < 0.005  # of ground between the other scan's rings
    assert (fit.observability.min() >= 1.0) == is_shown


@pytest.mark.parametrize("moved_m", [0.3, 0.7, 1.0, 1.5])
def test_rings_on_the_ground_that_the_sensor_moved_on_agree(moved_m):
    key = keyframe(field_scan(0.0), voxel_m=0.4)
    scan = keyframe(field_scan(moved_m), voxel_m=0.4).deskewed

    right, above = (
        fit_of(key, scan, exp(np.zeros(3), np.array([moved_m, 0.0, off_m])), max_pair_distance_m=0.5)
        for off_m in (0.0, 0.3)
    )

    assert right.agreement > 0.7
    assert above.agreement < 0.1


def test_a_prediction_fills_only_what_surfaces_do_not_show():
    key = keyframe(tunnel_scan(0, 30.0, seed=1), voxel_m=0.4)
    scan = keyframe(tunnel_scan(1, 31.0, seed=2), voxel_m=0.4).deskewed
    found = exp(np.zeros(3), np.array([3.0, 0.02, 0.0]))
    predicted = exp(np.zeros(3), np.array([1.0, 0.3, 0.0]))
    fit = fit_of(key, scan, found, max_pair_distance_m=0.5)

    pose, blend = observed_part(fit, predicted, found, Spread(0.001, 0.05), voxel_m=0.4)
    near, _ = observed_part(fit, predicted, found, Spread(0.5, 2.0), voxel_m=0.4)

    assert fit.unobservable.startswith("translation along x")
    np.testing.assert_allclose(pose[:3, 3], [1.0, 0.02, 0.0], atol=0.02)
    assert blend.open_m.max() == pytest.approx(0.05, rel=0.3)
    assert near[0, 3] > 2.5  # where predictions are bad, an uncertain measurement is better


@pytest.mark.parametrize("is_shown", [False, True])
def test_a_direction_that_disagrees_is_a_doubt_where_the_motion_was_predicted(is_shown):
    key, scan = keyframe(room_scan(0, seed=1)), keyframe(room_scan(1, OFF, seed=2)).deskewed
    fit = fit_of(key, scan, OFF, max_pair_distance_m=0.5)
    fit = replace(fit, observability=np.array([float(is_shown), 1.0, 1.0, 1.0, 1.0, 1.0]))
    state = ScanState(GicpMatcher(GicpOdometryConfig()))
    search = PoseSearch(GicpOdometryConfig(), state)
    for _ in range(6):
        state.usual.add(Shares(1.0, 0.9, 0.0))

    doubts = search.doubts(
        PoseCandidate(key, OFF, fit, Shares(1.0, 0.3, 0.0), jump_between(OFF, OFF, None), MEASURED, "map")
    )

    said = "" if is_shown else "30% agree in the weakest direction, 90% is usual"
    assert doubts_text(doubts) == said


@pytest.mark.parametrize(
    ("method", "shares", "is_doubted"),
    [
        ("rescued", Shares(0.5, 0.28, 0.008), True),
        ("keyframe", Shares(0.5, 0.28, 0.008), False),
        ("rescued", Shares(0.5, 0.5, 0.008), False),  # more agrees
        ("rescued", Shares(0.5, 0.28, 0.0035), False),  # about as usual
    ],
)
def test_a_pose_that_only_a_wide_search_found_has_to_agree_more(method, shares, is_doubted):
    key, scan = keyframe(room_scan(0, seed=1)), keyframe(room_scan(1, OFF, seed=2)).deskewed
    fit = fit_of(key, scan, OFF, max_pair_distance_m=0.5)
    state = ScanState(GicpMatcher(GicpOdometryConfig()))
    search = PoseSearch(GicpOdometryConfig(), state)
    for _ in range(6):
        state.usual.add(Shares(0.5, 0.9, 0.001))

    candidate = PoseCandidate(key, OFF, fit, shares, jump_between(OFF, OFF, None), MEASURED, method)

    kinds = [doubt.kind for doubt in search.doubts(candidate)]
    assert ("points in free space" in kinds) == is_doubted


@pytest.mark.parametrize(
    ("usual_contradicting", "shares", "contradicts"),
    [
        (0.001, Shares(0.5, 0.15, 0.0105), True),
        (0.001, Shares(0.5, 0.2, 0.0105), False),  # more agrees
        (0.001, Shares(0.5, 0.05, 0.0039), False),  # about as usual
        (0.02, Shares(0.5, 0.3, 0.03), False),  # rain
    ],
)
def test_few_contradictions_are_too_many_where_little_agrees(usual_contradicting, shares, contradicts):
    usual = UsualFit()
    for _ in range(5):
        usual.add(Shares(0.5, 0.2, usual_contradicting))

    assert usual.contradicts(shares) == contradicts


def test_a_pose_that_agrees_little_is_weak():
    usual = UsualFit()
    assert usual.is_weak(Shares(0.9, 0.7, 0.0))
    assert not usual.is_weak(Shares(0.9, 0.8, 0.0))
    for _ in range(5):
        usual.add(Shares(0.9, 0.6, 0.01))
    assert usual.is_weak(Shares(0.9, 0.4, 0.01))
    assert not usual.is_weak(Shares(0.9, 0.5, 0.01))
    assert usual.is_weak(Shares(0.9, 0.5, 0.02))


def test_a_weak_pose_is_less_certain_in_the_direction_where_the_least_agrees(monkeypatch):
    sigmas_m = {}
    for is_weak in (False, True):
        monkeypatch.setattr(UsualFit, "is_weak", lambda *_, is_weak=is_weak: is_weak)
        odometry = ScanOdometry(INDOOR, GicpMatcher(INDOOR))
        odometry.track(odometry.observe(room_scan(0, seed=1)))
        track = odometry.track(odometry.observe(room_scan(500_000_000, seed=2)))
        sigmas_m[is_weak] = np.sqrt(np.linalg.eigvalsh(track.covariance[3:, 3:]))

    assert sigmas_m[True].max() == pytest.approx(0.5 * 0.2, rel=0.05)  # half a voxel
    assert sigmas_m[True][1] < 2.0 * sigmas_m[False].max()


def test_less_than_a_part_of_the_usual_agreement_is_unusual_however_much_scans_differ():
    usual = UsualFit()
    for overlap, agreement in [(0.3, 0.1), (0.9, 0.9), (0.6, 0.5), (0.4, 0.2), (0.8, 0.8)]:
        usual.add(Shares(overlap, agreement, 0.0))

    assert usual.disagrees(Shares(0.6, 0.1, 0.0))
    assert not usual.disagrees(Shares(0.6, 0.2, 0.0))
    assert usual.agrees_little(Shares(0.6, 0.25, 0.0))
    assert not usual.agrees_little(Shares(0.6, 0.35, 0.0))


@pytest.mark.parametrize(
    ("shares", "off_m", "spread", "is_lost"),
    [
        (Shares(0.4, 0.1, 0.001), 0.1, Spread(0.01, 0.05), False),
        (Shares(0.4, 0.1, 0.03), 0.1, Spread(0.01, 0.05), True),
        (Shares(0.2, 0.1, 0.001), 0.1, Spread(0.01, 0.05), True),
        (Shares(0.4, 0.1, 0.001), 0.5, Spread(0.01, 0.05), True),  # a surprise
        (Shares(0.4, 0.1, 0.001), 1.5, Spread(0.1, 0.5), True),  # after a gap nothing is one
        (Shares(0.4, 0.1, 0.001), 0.1, None, True),
    ],
)
def test_little_overlap_where_the_pose_was_predicted_is_a_doubt(shares, off_m, spread, is_lost):
    key = keyframe(room_scan(0, seed=1))
    found = exp(np.zeros(3), np.array([off_m, 0.0, 0.0]))
    fit = fit_of(key, key.deskewed, np.eye(4), max_pair_distance_m=0.5)
    state = ScanState(GicpMatcher(GicpOdometryConfig()))
    search = PoseSearch(GicpOdometryConfig(), state)
    for _ in range(6):
        state.usual.add(Shares(0.9, 0.9, 0.001))
    candidate = PoseCandidate(
        key, found, fit, shares, jump_between(np.eye(4), found, spread), MEASURED, "map"
    )

    assert search.is_lost(candidate) == is_lost
    assert is_lost or len(search.doubts(candidate)) == 2


def test_points_are_where_the_truth_puts_them():
    here, there = room_scan(0, seed=1, noise_m=0.0), room_scan(1, OFF, seed=2, noise_m=0.0)
    _, distances_m = keyframe(here).deskewed.prepared.nearest(apply(OFF, there.points_body))
    assert np.median(distances_m) < 0.1
