"""Scans of a turning sensor, tracked again with the velocity that the next scan tells."""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from mapper.core.deskew import Twist
from mapper.core.geometry import angle_between, exp, inverse
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.node_offset import NodeOffset
from mapper.odometry.scan_to_map.config import GicpOdometryConfig
from mapper.odometry.scan_to_map.first_sweep import FirstSweep
from mapper.odometry.scan_to_map.motion_model import velocities_at
from mapper.odometry.scan_to_map.odometry import ScanOdometry
from mapper.odometry.scan_to_map.placed_scan import PlacedScan
from mapper.odometry.scan_to_map.scan_placement import ScanPlacement
from mapper.simulation.config import LIDAR_SCENES, LidarSynthConfig
from mapper.simulation.lidar import LidarSimulator

TURNING = LidarSynthConfig(
    seed=3, scene="flat", rate_hz=2.0, speed_mps=1.2, yaw_swing_rad=1.57, mount_height_m=1.3, duration_s=5.0
)
SCALE = 0.5  # of the lengths, as rooms have it


@cache
def source():
    sensor = TURNING.sensor.model_copy(update={"rings": 16})
    return LidarSimulator(TURNING.model_copy(update={"sensor": sensor})).log()


@cache
def tracked():
    """Return the odometry of the turning sensor, and the results of its scans."""
    odometry = build_frame_odometry(GicpOdometryConfig().scaled(SCALE))
    return odometry, [odometry.track(odometry.observe(entry.load())) for entry in source().entries()]


def turn_miss_rad(T_world_true, T_found):
    """Return the error of the rotation between two true poses."""
    return angle_between((inverse(T_world_true[0]) @ T_world_true[1])[:3, :3], T_found[:3, :3])


def test_three_poses_tell_the_velocity_at_the_first_and_at_the_one_between():
    acceleration, at_first = np.array([0.0, 0.0, 2.0]), np.array([0.0, 0.0, -0.5])
    poses = [exp(at_first * t + 0.5 * acceleration * t**2, np.zeros(3)) for t in (0.0, 0.5, 0.8)]

    first, second, change = velocities_at(poses, (0.5, 0.3))

    np.testing.assert_allclose(first.rotation_radps, at_first, atol=1e-9)
    np.testing.assert_allclose(second.rotation_radps, at_first + 0.5 * acceleration, atol=1e-9)
    np.testing.assert_allclose(change, [0.8, 0.8, 0.8, 0.0, 0.0, 0.0], atol=1e-9)  # over 0.4 s


def test_poses_of_one_time_tell_no_velocity():
    assert velocities_at([np.eye(4)] * 3, (0.5, 0.001)) is None


@pytest.mark.parametrize(("is_measured", "expected"), [(True, True), (False, False)])
def test_a_measured_turn_at_a_corner_is_not_what_three_poses_tell(is_measured, expected):
    covariance = np.diag([0.1**2] * 6)
    corner, smooth = (Twist(np.array([0.0, 0.0, turn]), np.zeros(3)) for turn in (3.0, 1.0))
    measured = PlacedScan(None, None, corner if is_measured else None, covariance)

    assert measured.turns_otherwise(replace(measured, twist=smooth)) == expected
    near = Twist(np.array([0.0, 0.0, 2.7]), np.zeros(3))
    assert not measured.turns_otherwise(replace(measured, twist=near))


def test_the_factors_of_a_turning_sensor_are_those_of_its_corrected_sweeps():
    odometry, tracks = tracked()
    factors = [factor for track in tracks for factor in track.factors] + list(odometry.finish())
    truth = {t.node: T for t, T in zip(tracks, source().truth.T_world_body, strict=True) if t.is_keyframe}
    at_once = [link for track in tracks for link in track.links]
    assert [(f.i, f.j) for f in factors] == [(f.i, f.j) for f in at_once]
    assert [f.j for f in factors] == list(range(1, len(truth)))

    corrected, first = (
        np.degrees([turn_miss_rad((truth[f.i], truth[f.j]), f.T_i_j) for f in some])
        for some in (factors, at_once)
    )

    assert np.mean(corrected) < 0.85 * np.mean(first)


def test_a_factor_comes_when_both_its_nodes_are_there():
    nodes = set()
    for track in tracked()[1]:
        nodes |= {track.node}
        assert all({factor.i, factor.j} <= nodes for factor in track.factors)


def test_corrected_scans_have_their_own_covariance_in_hindsight():
    odometry, tracks = tracked()
    later = odometry.in_hindsight(tracks)

    changed = [t.covariance is not h.covariance for t, h in zip(tracks, later, strict=True)]
    assert 2 <= sum(changed) < len(tracks)
    information = {f.j: f.information for t in tracks for f in t.factors}
    for before, track in pairwise(later):
        if changed[track.node] and track.is_keyframe and track.node == before.node + 1:
            expected = np.linalg.inv(information.get(track.node, odometry.finish()[0].information))
            np.testing.assert_allclose(track.covariance, expected, rtol=1e-6, atol=1e-12)


def test_a_sensor_that_stops_turning_is_not_lost():
    config = LIDAR_SCENES["flat"].model_copy(update={"seed": 54, "duration_s": 20.0})
    log = LidarSimulator(config).log()  # at a doorway it turns by 260° a second, and 0.2 s later by 50°
    odometry = build_frame_odometry(GicpOdometryConfig().scaled(SCALE))

    tracks = [odometry.track(odometry.observe(log.entry_at(index).load())) for index in range(46, 62)]

    assert all(track.node is not None for track in tracks)
    T_first_last, T_true = inverse(tracks[0].T_world_body) @ tracks[-1].T_world_body, log.truth.T_world_body
    miss = inverse(inverse(T_true[46]) @ T_true[61]) @ T_first_last
    assert np.linalg.norm(miss[:3, 3]) < 0.05


def test_a_log_may_begin_with_a_fast_turn():
    sensor = TURNING.sensor.model_copy(update={"rings": 16})
    config = TURNING.model_copy(update={"seed": 6, "rate_hz": 5.0, "sensor": sensor, "duration_s": 12.0})
    log = LidarSimulator(config).log()  # 206° a second at first, 0.2 s later 21°
    odometry = build_frame_odometry(GicpOdometryConfig().scaled(SCALE))

    tracks = [odometry.track(odometry.observe(log.entry_at(index).load())) for index in range(8)]

    assert all(track.node is not None for track in tracks)
    T_first_last, T_true = inverse(tracks[1].T_world_body) @ tracks[-1].T_world_body, log.truth.T_world_body
    miss = inverse(inverse(T_true[1]) @ T_true[7]) @ T_first_last
    assert np.linalg.norm(miss[:3, 3]) < 0.3  # 6 m otherwise


def begun(odometry, monkeypatch, scores):
    """Return the velocities by which a map's two scans are deskewed that fit with scores where they stand."""
    velocities = []

    def placed(*arguments):
        twist = arguments[-1]
        velocities.append(twist)
        score = scores(float(twist.rotation_radps[2]))
        found = SimpleNamespace(score=score, T_world_middle=np.eye(4))
        return None if score is None else SimpleNamespace(found=found)

    monkeypatch.setattr(FirstSweep, "_begun", placed)
    monkeypatch.setattr(ScanPlacement, "place", lambda *_: None)
    first, second, third = (source().entry_at(index).load() for index in range(3))
    odometry.track(odometry.observe(first))
    odometry.track(odometry.observe(second))
    number = len(velocities)
    odometry.track(odometry.observe(third))
    assert len(velocities) == number  # turns are tried once
    return velocities


def test_turns_are_tried_for_the_first_two_scans_only(monkeypatch):
    odometry = build_frame_odometry(GicpOdometryConfig().scaled(SCALE))

    velocities = begun(odometry, monkeypatch, lambda _: None)

    assert len(velocities) == 7
    assert np.linalg.norm(velocities[-1].vector) == 0.0


def test_a_turn_that_the_poses_do_not_show_is_not_taken(monkeypatch):
    odometry = build_frame_odometry(GicpOdometryConfig().scaled(SCALE))
    monkeypatch.setattr(ScanOdometry, "_not_found", lambda *_: None)

    velocities = begun(odometry, monkeypatch, lambda turning_radps: 0.1 * abs(turning_radps) or None)

    assert np.linalg.norm(velocities[-1].vector) == 0.0  # both scans bent alike fit each other


def test_a_sweep_whose_velocity_three_poses_contradict_is_less_certain(monkeypatch):
    monkeypatch.setattr(PlacedScan, "turns_otherwise", lambda *_: True)
    odometry = build_frame_odometry(GicpOdometryConfig().scaled(SCALE))
    tracks = [odometry.track(odometry.observe(entry.load())) for entry in source().entries()]
    later = odometry.in_hindsight(tracks)
    factors = {f.j: f for f in [f for track in tracks for f in track.factors] + list(odometry.finish())}

    changed = [
        k for k, (t, h) in enumerate(zip(tracks, later, strict=True)) if t.covariance is not h.covariance
    ]

    assert len(changed) >= 2
    for track, after in ((tracks[k], later[k]) for k in changed):
        np.testing.assert_array_equal(after.T_node_body, track.T_node_body)
        assert np.linalg.eigvalsh((after.covariance - track.covariance)[:3, :3]).min() > 0.0
        if track.is_keyframe:
            assert np.linalg.det(factors[track.node].information) < np.linalg.det(track.links[0].information)


def test_a_later_session_has_its_doubts_and_covariances_in_hindsight_too():
    odometry, tracks = tracked()
    own = odometry.in_hindsight(tracks)
    after_others = NodeOffset(build_frame_odometry(GicpOdometryConfig().scaled(SCALE)), first_node=7)
    results = [after_others.track(after_others.read(entry)) for entry in source().entries()]

    later = after_others.in_hindsight(results)

    assert [t.node for t in later] == [t.node + 7 for t in own]
    assert [t.doubts for t in later] == [t.doubts for t in own]
    assert [[(f.i, f.j) for f in t.links] for t in later] == [[(f.i, f.j) for f in t.links] for t in results]
    for track, expected in zip(later, own, strict=True):
        np.testing.assert_array_equal(track.T_node_body, expected.T_node_body)
        np.testing.assert_array_equal(track.covariance, expected.covariance)


@pytest.mark.parametrize("is_swept", [True, False])
def test_scans_without_times_have_their_factors_at_once(is_swept):
    odometry = build_frame_odometry(GicpOdometryConfig().scaled(SCALE))
    sensor = TURNING.sensor.model_copy(update={"rings": 16, "motion_distortion": is_swept})
    log = LidarSimulator(TURNING.model_copy(update={"sensor": sensor, "duration_s": 1.0})).log()

    tracks = [odometry.track(odometry.observe(entry.load())) for entry in log.entries()]

    assert (len(odometry.finish()) > 0) == is_swept
    assert all(track.factors == track.links for track in tracks) == (not is_swept)
