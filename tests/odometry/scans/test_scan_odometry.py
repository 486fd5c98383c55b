"""Every LiDAR odometry, on synthetic streets."""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import get_args

import numpy as np
import pytest

from mapper.core.deskew import Twist, deskewed
from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.core.geometry import angle_between, exp, inverse
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.scans.config import AnyScanOdometryConfig, GicpOdometryConfig
from mapper.runtime.state_file import dumps, loads
from mapper.simulation.config import STREET, LidarSensorConfig
from mapper.simulation.lidar import LidarSimulator

EVERY_KIND = [member() for member in get_args(AnyScanOdometryConfig)]
LIMITS = {"kiss-icp": (0.25, 0.5), "hough-ndt": (0.15, 1.5)}
"""After 9 m: metres, degrees; others' are 0.03 and 0.1."""
SENSOR = LidarSensorConfig(rings=32, azimuth_steps=450)


@cache
def street(seed=0, *, motion_distortion=False):
    sensor = SENSOR.model_copy(update={"motion_distortion": motion_distortion})
    return LidarSimulator(STREET.model_copy(update={"seed": seed, "duration_s": 2.5, "sensor": sensor})).log()


@cache
def scans(seed=0, *, motion_distortion=False):
    return [entry.load() for entry in street(seed, motion_distortion=motion_distortion).entries()]


def tracked(config, log):
    odometry = build_frame_odometry(config)
    return [odometry.track(odometry.observe(scan)) for scan in log]


def test_colours_times_and_intensities_do_not_hinder_tracking():
    scan = scans(motion_distortion=True)[0]
    n = len(scan.points_body)
    full = replace(scan, colors=np.zeros((n, 3), np.uint8), intensities=np.ones(n, np.float32))
    odometry = build_frame_odometry(GicpOdometryConfig())
    ours, bare = odometry.observe(full).scan, odometry.observe(scan).scan
    assert ours.points_body.tobytes() == bare.points_body.tobytes()
    assert (ours.colors, ours.intensities) == (None, None)


def misses(tracks, source, *, since=0):
    """Return how far each track lies from the truth, metres and radians, seen from one of them."""
    truth = source.truth.T_world_body[since:]
    found = []
    for track, T_world_body in zip(tracks[since:], truth, strict=True):
        T_first_body = inverse(tracks[since].T_world_body) @ track.T_world_body
        miss = inverse(inverse(truth[0]) @ T_world_body) @ T_first_body
        found.append((np.linalg.norm(miss[:3, 3]), angle_between(np.eye(3), miss[:3, :3])))
    return np.array(found)


@pytest.mark.parametrize("config", EVERY_KIND, ids=lambda config: config.kind)
def test_follows_a_street(config):
    tracks = tracked(config, scans())

    assert all(track.node is not None for track in tracks)
    # KISS-ICP, the library itself too, needs its first few scans to detect a motion.
    distance_m, angle_rad = misses(tracks, street(), since=6).max(axis=0)
    limit_m, limit_deg = LIMITS.get(config.kind, (0.03, 0.1))
    assert distance_m < limit_m
    assert np.degrees(angle_rad) < limit_deg


def test_sweeps_with_one_middle_do_not_divide_by_the_time_between_them():
    log = list(scans(motion_distortion=True)[:6])
    whole = log[3]
    inner = (whole.times_s > 0.01) & (whole.times_s < whole.times_s.max() - np.float32(0.01))
    earlier_s, later_s = (np.float64(t.min()) + t.max() for t in (whole.times_s, whole.times_s[inner]))
    shift_ns = round(0.5e9 * (earlier_s - later_s))
    log.insert(
        4,
        Scan(
            whole.stamp_ns + shift_ns, whole.points_body[inner], whole.origin_body, None, whole.times_s[inner]
        ),
    )

    tracks = tracked(GicpOdometryConfig(), log)

    assert all(track.node is not None for track in tracks)
    assert np.linalg.norm(tracks[4].T_world_body[:3, 3] - tracks[3].T_world_body[:3, 3]) < 0.02
    speeds_mps = [np.linalg.norm(track.twist.translation_mps) for track in tracks[2:]]
    assert max(speeds_mps) < 1.2 * min(speeds_mps)


@pytest.mark.parametrize("config", EVERY_KIND, ids=lambda config: config.kind)
def test_tracking_goes_on_from_a_written_state(config):
    odometry = build_frame_odometry(config)
    for scan in scans()[:5]:
        odometry.track(odometry.observe(scan))
    again = loads(dumps(odometry))

    one, other = (each.track(each.observe(scans()[5])) for each in (odometry, again))

    assert one.T_world_body.tobytes() == other.T_world_body.tobytes()


@pytest.mark.parametrize("config", EVERY_KIND, ids=lambda config: config.kind)
def test_keyframes_are_connected_in_a_chain(config):
    tracks = tracked(config, scans()[:12])

    keyframes = [track for track in tracks if track.is_keyframe]
    assert [track.node for track in keyframes] == list(range(len(keyframes)))
    assert len(keyframes) > 3
    for before, track in pairwise(keyframes):
        (factor,) = track.factors
        assert (factor.i, factor.j) == (before.node, track.node)
        np.testing.assert_allclose(factor.T_i_j, inverse(before.T_world_body) @ track.T_world_body, atol=1e-9)
    poses = {track.node: track.T_world_body for track in keyframes}
    for track in tracks:
        np.testing.assert_allclose(poses[track.node] @ track.T_node_body, track.T_world_body, atol=1e-9)


def test_motion_during_the_sweep_is_undone():
    source = street(motion_distortion=True)
    swept = scans(motion_distortion=True)
    as_if_at_rest = [Scan(scan.stamp_ns, scan.points_body) for scan in swept]

    deskewed_m = misses(tracked(GicpOdometryConfig(), swept), source)[-1, 0]
    ignored_m = misses(tracked(GicpOdometryConfig(), as_if_at_rest), source)[-1, 0]

    assert deskewed_m < 0.05
    assert deskewed_m < 0.5 * ignored_m


def test_the_first_scan_is_unfit_for_place_recognition_until_its_motion_is_known():
    tracks = tracked(GicpOdometryConfig(), scans(motion_distortion=True)[:3])

    assert [track.is_sharp for track in tracks] == [False, True, True]
    np.testing.assert_allclose(tracks[0].T_world_body, np.eye(4))


def test_a_view_is_deskewed_to_its_stamp():
    scan = scans(motion_distortion=True)[0]
    odometry = build_frame_odometry(GicpOdometryConfig())
    observation = odometry.observe(scan)
    twist = Twist(np.zeros(3), np.array([5.0, 0.0, 0.0]))

    seen = odometry.view(observation, twist)

    exact = {tuple(point) for point in deskewed(scan, twist).points_body.tolist()}
    assert seen.stamp_ns == scan.stamp_ns
    assert len(seen.points_body) > 1000
    assert {tuple(point) for point in seen.points_body.tolist()} <= exact


def test_a_jump_beyond_the_map_is_registered_without_a_guess():
    log = scans()
    turned = exp(np.array([0.0, 0.0, np.radians(120.0)]), np.array([2.0, 1.0, 0.0]))
    here = log[8].points_body @ turned[:3, :3].T.astype(np.float32) + turned[:3, 3].astype(np.float32)
    jumped = Scan(log[8].stamp_ns, here.astype(np.float32))

    tracks = tracked(GicpOdometryConfig(), [*log[:8], jumped])

    assert tracks[-1].diagnostics.method == "rescued"
    T_jumped_body = inverse(tracks[-1].T_world_body) @ tracked(GicpOdometryConfig(), log[:9])[-1].T_world_body
    np.testing.assert_allclose(T_jumped_body, turned, atol=0.05)


def test_another_street_is_lost_and_then_begins_a_sub_map(monkeypatch):
    monkeypatch.setattr("mapper.odometry.scans.odometry.MOST_LOST_SCANS", 2)
    config = GicpOdometryConfig(rescue=None)
    elsewhere = [
        Scan(scan.stamp_ns + 10_000_000_000, (scan.points_body * [1.0, -1.0, 1.0]).astype(np.float32))
        for scan in (street(5).entry_at(index).load() for index in range(6))
    ]

    tracks = tracked(config, [*scans()[:6], *elsewhere])

    methods = [track.diagnostics.method for track in tracks[6:]]
    assert methods == ["lost", "lost", "new sub-map", "map", "map", "map"]
    assert tracks[6].node is None
    assert tracks[8].factors == ()


def test_a_corridor_reports_an_unobservable_motion_and_leaves_it_open():
    rng = np.random.default_rng(3)
    log = []
    for index in range(4):
        along, across = rng.uniform(-40.0, 40.0, 9000), rng.uniform(-2.0, 2.0, 9000)
        up = rng.uniform(0.0, 3.0, 9000)
        side = np.where(rng.random(9000) < 0.5, -2.0, 2.0)
        floor = np.column_stack([along, across, np.zeros(9000)])
        walls = np.column_stack([along, side, up])
        points = np.concatenate([floor, walls]) + rng.normal(0.0, 0.01, (18000, 3)) - [0.0, 0.05 * index, 1.2]
        log.append(Scan(index * 100_000_000, points.astype(np.float32)))
    config = GicpOdometryConfig(keyframe_distance_m=0.04)

    tracks = tracked(config, log)

    assert "translation along x" in tracks[1].diagnostics.unobservable
    information = tracks[1].factors[0].information
    assert information[3, 3] < 1e-3 * information[4, 4]


def test_a_scan_of_few_points_is_refused():
    odometry = build_frame_odometry(GicpOdometryConfig())
    few = Scan(5, np.full((40, 3), 7.0, np.float32))

    with pytest.raises(FrameError, match="40 points, of which 1 are left"):
        odometry.observe(few)
