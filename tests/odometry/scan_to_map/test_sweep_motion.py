"""Velocity during a sweep, found together with the pose."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.deskew import STILL, Twist, deskewed
from mapper.core.frames import Scan
from mapper.core.geometry import angle_between, apply, exp, inverse
from mapper.odometry.scan_to_map.gicp import GicpMatcher
from mapper.odometry.scan_to_map.motion_model import MotionModel
from mapper.odometry.scan_to_map.odometry import ScanOdometry
from mapper.odometry.scan_to_map.scan_fit import ScanKeyframe
from mapper.odometry.scan_to_map.scan_matcher import DeskewedScan
from mapper.odometry.scan_to_map.sweep_motion import sweep_motion
from mapper.registration.surfaces import prepared
from tests.support.room_scans import INDOOR

TURNING = Twist(np.array([0.1, -0.2, 2.0]), np.array([0.6, 0.2, 0.0]))
SWEEP_S = 0.1
WIDE = np.diag([4.0] * 3 + [1.0] * 3)


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

    found = sweep_motion([room_keyframe()], sweep, guess, STILL, WIDE, start=STILL, max_pair_distance_m=0.25)

    sigmas = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(found.twist.rotation_radps, TURNING.rotation_radps, atol=0.15)
    assert sigmas[:3].max() < 0.2
    error = inverse(T_world_middle) @ found.T_world_middle
    assert angle_between(np.eye(3), error[:3, :3]) < np.radians(0.4)
    assert np.linalg.norm(error[:3, 3]) < 0.02


def test_a_certain_velocity_is_kept():
    sweep = swept_room(np.eye(4), TURNING, seed=2)

    found = sweep_motion(
        [room_keyframe()], sweep, np.eye(4), TURNING, 1e-8 * WIDE, start=STILL, max_pair_distance_m=0.25
    )

    np.testing.assert_allclose(found.twist.rotation_radps, TURNING.rotation_radps, atol=0.01)


def test_too_few_pairs_tell_no_velocity():
    sweep, far = swept_room(np.eye(4), STILL), exp(np.zeros(3), np.array([80.0, 0.0, 0.0]))

    found = sweep_motion([room_keyframe()], sweep, far, STILL, WIDE, start=STILL, max_pair_distance_m=0.25)

    assert found is None


def test_the_expected_velocity_goes_on_as_it_changed():
    motion = MotionModel(0, np.eye(4))
    turn = np.array([0.0, 0.0, 1.0])
    motion.follow(500_000_000, exp(0.5 * turn, np.zeros(3)), measured=(Twist(turn, np.zeros(3)), np.eye(6)))

    twist, covariance = motion.velocity(1_000_000_000, exp(1.5 * turn, np.zeros(3)), np.zeros((6, 6)))

    np.testing.assert_allclose(twist.rotation_radps, 2.5 * turn, atol=1e-9)  # 3/2 · 2 − 1/2 · 1
    np.testing.assert_allclose(np.diag(covariance), [0.75 + 0.25] * 3 + [0.25] * 3)


def velocity_errors(told, *, count=300):
    """Return the errors of the velocity along x, of steps of 0.2 m whose poses are off by 0.1 m along it."""
    rng = np.random.default_rng(1)
    motion, errors_mps = MotionModel(0, np.eye(4)), []
    for k in range(1, count):
        time_ns, is_known = k * 100_000_000, k <= 60
        off_m = rng.normal(0.0, 0.01 if is_known else 0.1)
        T_world_body = exp(np.zeros(3), np.array([0.2 * k + off_m, 0.0, 0.0]))
        expected = motion.velocity(time_ns, T_world_body, told)
        measured = None if is_known else expected
        motion.follow(time_ns, T_world_body, is_certain=is_known, pose_covariance=told, measured=measured)
        errors_mps.append(abs(motion.twist.translation_mps[0] - 2.0))
    return errors_mps[100:]


def test_poses_that_nothing_shows_along_a_direction_do_not_change_the_expected_velocity():
    assert np.mean(velocity_errors(np.diag([1e-6] * 3 + [0.01] + [1e-6] * 2))) < 0.5
    assert np.mean(velocity_errors(np.zeros((6, 6)))) > 1.5


def test_the_variance_of_the_expected_velocity_is_that_of_its_errors():
    """Random accelerations over steps of 0.1 s, and poses off by as much as these move the body."""
    rng = np.random.default_rng(2)
    step_s, density, off_m = 0.1, 30.0, 0.05
    variances = density * np.array([[step_s**3 / 3.0, step_s**2 / 2.0], [step_s**2 / 2.0, step_s]])
    told = np.diag([1e-8] * 3 + [off_m**2] * 3)
    normalised = []
    for _ in range(40):
        motion, x_m, speed_mps = MotionModel(0, np.eye(4)), 0.0, 0.0
        for k in range(1, 60):
            moved_m, changed_mps = rng.multivariate_normal([0.0, 0.0], variances)
            x_m, speed_mps = x_m + speed_mps * step_s + moved_m, speed_mps + changed_mps
            T_world_body = exp(np.zeros(3), np.array([x_m + rng.normal(0.0, off_m), 0.0, 0.0]))
            expected = motion.velocity(k * 100_000_000, T_world_body, told)
            motion.follow(k * 100_000_000, T_world_body, pose_covariance=told, measured=expected)
            if k > 20:
                error_mps = expected[0].translation_mps[0] - speed_mps
                normalised.append(error_mps**2 / expected[1][3, 3])

    assert 0.5 < np.mean(normalised) < 2.0


def test_the_rotation_changes_as_much_after_it_was_measured():
    changes = []
    for measured in (None, (STILL, np.eye(6))):
        motion = MotionModel(0, np.eye(4))
        for k in range(1, 12):
            T_world_body = exp(np.array([0.0, 0.0, 0.2 * (k % 2)]), np.zeros(3))
            motion.follow(k * 500_000_000, T_world_body, measured=measured if k == 11 else None)
        changes.append(motion.turning_change(6_000_000_000))

    assert changes[0] > 0.3
    assert changes[1] >= 0.9 * changes[0]
    assert MotionModel(0, np.eye(4)).turning_change(500_000_000) is None


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
        scan = swept_room(at[1], twist, stamp_ns=round(k * dt_s * 1e9), seed=k)
        scan = replace(scan, times_s=scan.times_s * np.float32(sweep_s / SWEEP_S))
        results.append(odometry.track(odometry.observe(scan)))
    return results


@pytest.mark.parametrize(("sweep_s", "least_undoubted"), [(0.1, 12), (0.4, 9)])
def test_sudden_turns_are_tracked_or_doubtful(sweep_s, least_undoubted):
    results = tracked_turns(sweep_s)

    assert all(result.node is not None for result in results)
    errors_rad = [
        angle_between(exp(np.array([0.0, 0.0, yaw_rad(k)]), np.zeros(3))[:3, :3], result.T_world_body[:3, :3])
        for k, result in enumerate(results)
        if not result.doubts
    ]
    assert len(errors_rad) >= least_undoubted
    assert max(errors_rad) < np.radians(4.0)


def test_sweeps_that_turn_at_an_unknown_rate_are_doubtful():
    results = tracked_turns(0.5)

    doubts = [doubt.text for result in results for doubt in result.doubts]
    assert any("points may be displaced by" in doubt and "its sweep of 0.5 s" in doubt for doubt in doubts)
    assert not any(result.doubts for result in results[:8])
