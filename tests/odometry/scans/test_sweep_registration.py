"""Velocity during a sweep, found together with the pose."""

from dataclasses import replace

import numpy as np

from mapper.core.deskew import STILL, Twist, deskewed
from mapper.core.frames import Scan
from mapper.core.geometry import angle_between, apply, exp, inverse
from mapper.odometry.motion_prior import MotionPrior
from mapper.odometry.scans.config import GicpOdometryConfig
from mapper.odometry.scans.gicp_matcher import GicpMatcher
from mapper.odometry.scans.motion_model import MotionModel
from mapper.odometry.scans.odometry import ScanOdometry
from mapper.odometry.scans.scan_fit import ScanKeyframe
from mapper.odometry.scans.scan_matcher import DeskewedScan
from mapper.odometry.scans.sweep_registration import fit_sweep_motion
from mapper.registration.surfaces import prepared

TURNING = Twist(np.array([0.1, -0.2, 2.0]), np.array([0.6, 0.2, 0.0]))
SWEEP_S = 0.1
WIDE = np.diag([4.0] * 3 + [1.0] * 3)
INDOOR = GicpOdometryConfig(voxel_m=0.2, cell_m=0.25, coarse_cell_m=1.0, min_range_m=0.3, rescue=None)


def swept_room(T_world_middle, twist, *, stamp_ns=0, seed=0, points=9000):
    """Return a room as a sweep measures it, with times from the sweep's middle."""
    rng = np.random.default_rng(seed)
    half = np.array([4.0, 3.0, 1.4])
    inside = rng.uniform(-1.0, 1.0, (points, 3))
    axis = rng.integers(0, 3, points)
    inside[np.arange(points), axis] = np.sign(inside[np.arange(points), axis])
    pillar = rng.uniform([1.2, 0.8, -1.4], [1.2, 1.6, 1.4], (points // 10, 3))
    world = np.concatenate([inside * half, pillar]) + rng.normal(0.0, 0.01, (points + points // 10, 3))
    seen = apply(inverse(T_world_middle), world)
    times_s = (np.arctan2(seen[:, 1], seen[:, 0]) / (2.0 * np.pi) * SWEEP_S).astype(np.float32)
    backwards = Twist(-twist.rotation_radps, -twist.translation_mps)
    scan = deskewed(Scan(stamp_ns, seen.astype(np.float32), times_s=times_s), backwards)
    return replace(scan, times_s=times_s)


def room_keyframe():
    scan = replace(swept_room(np.eye(4), STILL, seed=1), times_s=None)
    return ScanKeyframe(0, DeskewedScan(scan, prepared(scan.points_body, voxel_m=0.2)), np.eye(4), np.eye(4))


def test_pose_and_velocity_are_found_together():
    T_world_middle = exp(np.array([0.0, 0.0, 0.3]), np.array([0.4, 0.1, 0.0]))
    sweep = swept_room(T_world_middle, TURNING, seed=2)
    guess = T_world_middle @ exp(np.array([0.0, 0.0, 0.05]), np.array([0.05, -0.05, 0.02]))

    found = fit_sweep_motion(
        [room_keyframe()], sweep, guess, STILL, WIDE, start=STILL, max_pair_distance_m=0.25
    )

    sigmas = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(found.twist.rotation_radps, TURNING.rotation_radps, atol=0.15)
    assert sigmas[:3].max() < 0.2
    error = inverse(T_world_middle) @ found.T_world_middle
    assert angle_between(np.eye(3), error[:3, :3]) < np.radians(0.4)
    assert np.linalg.norm(error[:3, 3]) < 0.02


def test_a_certain_velocity_is_kept():
    sweep = swept_room(np.eye(4), TURNING, seed=2)

    found = fit_sweep_motion(
        [room_keyframe()], sweep, np.eye(4), TURNING, 1e-8 * WIDE, start=STILL, max_pair_distance_m=0.25
    )

    np.testing.assert_allclose(found.twist.rotation_radps, TURNING.rotation_radps, atol=0.01)


def test_too_few_pairs_tell_no_velocity():
    sweep, far = swept_room(np.eye(4), STILL), exp(np.zeros(3), np.array([80.0, 0.0, 0.0]))

    found = fit_sweep_motion(
        [room_keyframe()], sweep, far, STILL, WIDE, start=STILL, max_pair_distance_m=0.25
    )

    assert found is None


def test_the_expected_velocity_goes_on_as_it_changed():
    motion = MotionModel(0, np.eye(4), MotionPrior(None))
    turn = np.array([0.0, 0.0, 1.0])
    motion.follow(500_000_000, exp(0.5 * turn, np.zeros(3)), measured=(Twist(turn, np.zeros(3)), np.eye(6)))

    twist, covariance = motion.velocity(1_000_000_000, exp(1.5 * turn, np.zeros(3)))

    np.testing.assert_allclose(twist.rotation_radps, 2.5 * turn, atol=1e-9)  # 3/2 · 2 − 1/2 · 1
    np.testing.assert_allclose(np.diag(covariance), [0.75 + 0.25] * 3 + [0.25] * 3)


def yaw_rad(k):
    """Return the heading of a sensor that looks to and fro, and begins to do so suddenly, by scan."""
    return 0.02 * k if k < 8 else 0.16 + 1.2 * (1.0 - np.cos(0.9 * (k - 8)))


def tracked_turns(sweep_s, count=16, dt_s=0.5):
    odometry = ScanOdometry(INDOOR, GicpMatcher(INDOOR))
    results = []
    for k in range(count):
        at = [exp(np.array([0.0, 0.0, yaw_rad(k + d)]), np.zeros(3)) for d in (-0.05, 0.0, 0.05)]
        rate = (yaw_rad(k + 0.05) - yaw_rad(k - 0.05)) / (0.1 * dt_s)
        twist = Twist(np.array([0.0, 0.0, rate * sweep_s / SWEEP_S]), np.zeros(3))
        scan = swept_room(at[1], twist, stamp_ns=round(k * dt_s * 1e9), seed=k, points=5000)
        scan = replace(scan, times_s=scan.times_s * np.float32(sweep_s / SWEEP_S))
        results.append(odometry.track(odometry.observe(scan)))
    return results


def test_sudden_turns_are_tracked_where_sweeps_are_short():
    results = tracked_turns(0.1)

    assert all(result.node is not None for result in results)
    errors_rad = [
        angle_between(exp(np.array([0.0, 0.0, yaw_rad(k)]), np.zeros(3))[:3, :3], result.T_world_body[:3, :3])
        for k, result in enumerate(results)
        if not result.doubts
    ]
    assert len(errors_rad) >= 12
    assert max(errors_rad) < np.radians(4.0)


def test_sweeps_that_turn_at_an_unknown_rate_are_doubtful():
    results = tracked_turns(0.4, count=11)

    assert [bool(result.doubts) for result in results] == [False] * 9 + [True] * 2
