"""Doubts, repeated search and covariance of the LiDAR odometries."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.core.geometry import angle_between, exp, inverse, log
from mapper.graph.config import WheelNoiseConfig
from mapper.odometry.motion_prior import MotionPrior
from mapper.odometry.scans.config import GicpOdometryConfig
from mapper.odometry.scans.gicp_matcher import GicpMatcher
from mapper.odometry.scans.motion_model import MotionModel, Spread
from mapper.odometry.scans.odometry import ScanOdometry
from mapper.odometry.scans.pose_assessment import FitStatistics
from mapper.odometry.scans.pose_candidate import Shares, fuse_with_prediction, jump_between
from mapper.odometry.scans.scan_fit import ScanKeyframe, contradiction, described, fit_of
from mapper.odometry.scans.scan_matcher import DeskewedScan
from mapper.odometry.scans.scan_noise import ScanNoise, surface_covariance
from mapper.registration.pair_refinement import refine
from mapper.registration.surfaces import prepared

ROOM = np.array([[-4.0, 4.0], [-3.0, 3.0], [-1.2, 1.6]])
OFF = exp(np.array([0.0, 0.0, np.radians(15.0)]), np.array([0.5, 0.3, 0.0]))


def room_scan(stamp_ns, T_world_body=None, *, seed=0, points=6000, noise_m=0.02):
    """Return what is seen of a room with a pillar and a cupboard, rays from the body through them."""
    rng = np.random.default_rng(seed)
    T_world_body = np.eye(4) if T_world_body is None else T_world_body
    pillar = np.array([[1.2, 1.8], [0.8, 1.5], [-1.2, 1.6]])
    cupboard = np.array([[-3.9, -3.1], [-2.9, -1.0], [-1.2, 0.6]])
    directions = rng.normal(size=(points, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    rays, origin = directions @ T_world_body[:3, :3].T, T_world_body[:3, 3]
    ranges = np.full(points, np.inf)
    for number, box in enumerate((ROOM, pillar, cupboard)):
        with np.errstate(divide="ignore"):
            ends = (box.T[:, None, :] - origin) / rays
        enter, leave = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
        if number == 0:
            ranges = np.minimum(ranges, leave)
        else:
            ranges = np.where((enter < leave) & (enter > 0.0), np.minimum(ranges, enter), ranges)
    measured = directions * (ranges + rng.normal(0.0, noise_m, points))[:, None]
    return Scan(stamp_ns, measured.astype(np.float32))


def keyframe(scan, *, voxel_m=0.2):
    deskewed = DeskewedScan(scan, prepared(scan.points_body, voxel_m=voxel_m))
    return ScanKeyframe(0, deskewed, np.eye(4), np.eye(4))


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


def corridor_scan(*, seed, rings):
    """Return what rings see of a corridor 160 m long, bare: at any place along it the same."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = np.meshgrid(
        np.linspace(0.0, 2.0 * np.pi, 900, endpoint=False), np.radians(np.linspace(-15.0, 15.0, rings))
    )
    parts = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    directions = np.stack(parts, axis=-1).reshape(-1, 3)
    with np.errstate(divide="ignore"):
        ends = np.array([[[-80.0, -1.2, -1.2]], [[80.0, 1.2, 1.4]]]) / directions
    ranges = ends.max(axis=0).min(axis=1) + rng.normal(0.0, 0.015, len(directions))
    points = (directions * ranges[:, None])[(ranges > 0.3) & (ranges < 30.0)]
    return Scan(0, points.astype(np.float32))


@pytest.mark.parametrize("rings", [16, 32, 64])
def test_no_number_of_rings_shows_the_motion_along_a_bare_corridor(rings):
    config = GicpOdometryConfig(voxel_m=0.15)
    first, second = (corridor_scan(seed=seed, rings=rings) for seed in (0, 1))
    odometry = ScanOdometry(config, GicpMatcher(config))
    odometry.track(odometry.observe(first))
    track = odometry.track(odometry.observe(replace(second, stamp_ns=100_000_000)))

    assert track.diagnostics.unobservable == "translation along x"
    assert [doubt.kind for doubt in track.doubts] == ["unobservable"]


class MisledMatcher(GicpMatcher):
    """GICP that is off by 15° and 0.58 m when the predicted pose is used as it is."""

    misled = False

    def match(self, deskewed, T_world_body, *, reach):
        found = super().match(deskewed, T_world_body, reach=reach)
        return found if found is None or not self.misled else found @ OFF


INDOOR = GicpOdometryConfig(voxel_m=0.2, cell_m=0.25, coarse_cell_m=1.0, min_range_m=0.3, rescue=None)


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
    monkeypatch.setattr(FitStatistics, "agrees_little", lambda *_: True)
    matcher.count = 0
    track = odometry.track(odometry.observe(room_scan(4_000_000_000, seed=8)))

    assert 3 <= matcher.count <= 10  # of 8 guesses, each to the map and to two scans
    assert np.linalg.norm(track.T_world_body[:3, 3]) < 0.02


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


def test_what_a_tunnel_does_not_show_is_predicted_and_doubted():
    odometry = ScanOdometry(GicpOdometryConfig(), GicpMatcher(GicpOdometryConfig()))
    places_m = [-5.0 + 0.5 * k for k in range(75)]  # the piers are out of sight from 20 m on
    tracks = [
        odometry.track(odometry.observe(tunnel_scan(k * 100_000_000, x_m, seed=k)))
        for k, x_m in enumerate(places_m)
    ]

    blind, clear = tracks[56:], tracks[10:40]
    assert all("translation along x" in track.diagnostics.unobservable for track in blind)
    assert all(any(doubt.kind == "unobservable" for doubt in track.doubts) for track in blind[3:])
    assert not any(track.doubts for track in clear)
    travelled_m = tracks[-1].T_world_body[0, 3] - tracks[40].T_world_body[0, 3]
    assert travelled_m == pytest.approx(places_m[-1] - places_m[40], abs=1.0)
    sigmas_m = [np.sqrt(track.covariance[3, 3]) for track in (blind[-1], clear[-1])]
    assert sigmas_m[0] > 3.0 * sigmas_m[1]
    assert np.sqrt(blind[-1].covariance[4, 4]) < 0.05


def test_unusual_shares():
    log = FitStatistics()
    for k in range(20):
        log.add(Shares(0.98 - 0.002 * (k % 3), 0.9, 0.001))

    assert log.has_little_overlap(Shares(0.56, 0.5, 0.0), usual_ratio=0.8)
    assert not log.has_little_overlap(Shares(0.85, 0.8, 0.0), usual_ratio=0.8)
    assert log.contradicts(Shares(0.9, 0.9, 0.05))
    assert not log.contradicts(Shares(0.9, 0.9, 0.008))
    assert log.disagrees(Shares(0.9, 0.3, 0.0))
    log.clear()
    assert not log.has_little_overlap(Shares(0.82, 0.5, 0.0), usual_ratio=0.8)


def test_the_spread_of_predictions_is_the_logs_own():
    rng = np.random.default_rng(1)
    motion = MotionModel(0, np.eye(4), MotionPrior(None))
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


def test_a_wrong_pose_contradicts_free_space():
    here, there = room_scan(0, seed=1, points=30000), room_scan(1, OFF, seed=2, points=30000)
    key, description = keyframe(here), described(keyframe(there).deskewed)

    assert contradiction(key, description, OFF) < 0.02
    assert contradiction(key, description, np.eye(4)) > 0.03


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


@pytest.mark.parametrize("moved_m", [0.01, 0.1, 0.39, 0.41, 1.0])  # voxels of 0.4 m
def test_a_few_bushes_in_a_field_show_a_motion(moved_m):
    key = keyframe(field_scan(0.0), voxel_m=0.4)
    scan = keyframe(field_scan(moved_m), voxel_m=0.4).deskewed
    right = exp(np.zeros(3), np.array([moved_m, 0.0, 0.0]))

    fit = fit_of(key, scan, right, max_pair_distance_m=0.5)

    assert fit.contradicting < 0.005  # of ground between the other scan's rings
    assert fit.observability.min() > 0.99


@pytest.mark.parametrize("moved_m", [0.01, 0.1, 0.39, 0.41, 1.0])
def test_a_bare_tunnel_does_not_show_a_motion_along_it(moved_m):
    key = keyframe(tunnel_scan(0, 30.0, seed=1), voxel_m=0.4)
    scan = keyframe(tunnel_scan(1, 30.0 + moved_m, seed=2), voxel_m=0.4).deskewed

    fit = fit_of(key, scan, exp(np.zeros(3), np.array([moved_m, 0.0, 0.0])), max_pair_distance_m=0.5)

    assert fit.observability[0] < 0.3
    assert fit.observability[1:].min() > 0.9


def test_a_prediction_fills_only_what_surfaces_do_not_show():
    key = keyframe(tunnel_scan(0, 30.0, seed=1), voxel_m=0.4)
    scan = keyframe(tunnel_scan(1, 31.0, seed=2), voxel_m=0.4).deskewed
    found = exp(np.zeros(3), np.array([3.0, 0.02, 0.0]))
    predicted = exp(np.zeros(3), np.array([1.0, 0.3, 0.0]))
    fit = fit_of(key, scan, found, max_pair_distance_m=0.5)

    pose, open_m = fuse_with_prediction(fit, predicted, found, Spread(0.001, 0.05), voxel_m=0.4)
    near, _ = fuse_with_prediction(fit, predicted, found, Spread(0.5, 2.0), voxel_m=0.4)
    wheels = Spread(1e-5, 1e-5, is_by_wheels=True)  # so sure that a correction as large has no chance
    rolled, _ = fuse_with_prediction(fit, predicted, found, wheels, voxel_m=0.4)

    assert fit.unobservable.startswith("translation along x")
    np.testing.assert_allclose(pose[:3, 3], [1.0, 0.02, 0.0], atol=0.02)
    assert open_m.max() == pytest.approx(0.05, rel=0.3)
    assert near[0, 3] > 2.5  # where predictions are bad, an uncertain measurement is better
    assert rolled[0, 3] == pytest.approx(1.0, abs=0.02)


def test_the_covariance_covers_what_noise_does():
    squares, truth = [], exp(np.array([0.0, 0.0, 0.03]), np.array([0.3, 0.1, 0.0]))
    for seed in range(12):
        key = keyframe(room_scan(0, seed=2 * seed, noise_m=0.03))
        scan = keyframe(room_scan(1, truth, seed=2 * seed + 1, noise_m=0.03)).deskewed
        found = refine(
            key.deskewed.prepared, scan.prepared, truth, kind="plane-icp", pair_distances_m=(0.5,)
        ).T_target_source
        fit = fit_of(key, scan, found, max_pair_distance_m=0.5)
        error = np.concatenate(log(inverse(truth) @ found))
        squares.append(error @ np.linalg.solve(surface_covariance(fit), error) / 6.0)

    assert 0.4 < np.mean(squares) < 2.5


def noise_of(T_key_scan, *, noise_m):
    """Return the sigmas of a room's scan."""
    key = keyframe(room_scan(0, seed=1, noise_m=noise_m))
    scan = keyframe(room_scan(1, T_key_scan, seed=2, noise_m=noise_m)).deskewed
    fit = fit_of(key, scan, T_key_scan, max_pair_distance_m=0.5)
    noise = ScanNoise(WheelNoiseConfig()).of(fit, np.zeros(6), T_key_scan, 0.1, np.zeros((6, 6)))
    return np.sqrt(np.diag(noise.covariance))


def test_a_turn_on_the_spot_is_known_as_well_as_none():
    still = noise_of(np.eye(4), noise_m=0.01)
    turned = noise_of(exp(np.array([0.0, 0.0, 0.6]), np.zeros(3)), noise_m=0.01)

    assert turned[:3].max() < 2.0 * still[:3].max()  # the azimuth of a turning sensor has no scale error


def test_the_model_error_follows_the_distances_from_surfaces():
    T_key_scan = exp(np.array([0.0, 0.0, 0.03]), np.array([0.5, 0.1, 0.0]))
    near, far = (noise_of(T_key_scan, noise_m=noise_m) for noise_m in (0.005, 0.05))

    assert far[3:].min() > 3.0 * near[3:].min()


def test_a_motion_that_two_scans_leave_open_is_no_doubt():
    key, scan = keyframe(room_scan(0, seed=1)), keyframe(room_scan(1, OFF, seed=2)).deskewed
    fit = fit_of(key, scan, OFF, max_pair_distance_m=0.5)
    fit = replace(fit, observability=np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0]))
    noise, open_m = ScanNoise(WheelNoiseConfig()), np.array([0.012, 0.0, 0.0, 0.0, 0.0, 0.0])

    doubts = [noise.of(fit, open_m, OFF, 0.1, np.zeros((6, 6))).doubts for _ in range(4)]

    assert [bool(doubt) for doubt in doubts] == [False, False, True, True]
