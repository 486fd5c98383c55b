"""A scan swept in motion becomes the scan of one moment."""

import numpy as np
import pytest

from mapper.core.deskew import STILL, SampledMotion, Twist, deskewed, twist_at, twist_between
from mapper.core.frames import Scan
from mapper.core.geometry import apply, exp
from mapper.core.trajectory import Trajectory

TWIST = Twist(np.array([0.3, -0.2, 0.9]), np.array([8.0, 0.5, -0.1]))


def swept(count=500, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-40.0, 40.0, (count, 3)).astype(np.float32)
    return Scan(7, points, times_s=np.linspace(-0.04, 0.1, count, dtype=np.float32))


def test_every_point_moves_by_the_exponential_of_its_time():
    scan = swept()
    expected = [
        apply(exp(TWIST.rotation_radps * t, TWIST.translation_mps * t), point[np.newaxis])[0]
        for t, point in zip(scan.times_s.astype(float), scan.points_body.astype(float), strict=True)
    ]

    found = deskewed(scan, TWIST)

    np.testing.assert_allclose(found.points_body, expected, atol=2e-5)
    assert found.times_s is None
    assert found.stamp_ns == scan.stamp_ns


def test_a_slow_turn_is_as_exact_as_none():
    scan = swept()
    crawling = Twist(np.array([0.0, 0.0, 1e-7]), TWIST.translation_mps)
    shifted = scan.points_body + scan.times_s[:, np.newaxis] * TWIST.translation_mps

    np.testing.assert_allclose(deskewed(scan, crawling).points_body, shifted, atol=2e-5)


def test_a_body_at_rest_moves_nothing_and_its_input_stays():
    scan = swept()
    before = scan.points_body.copy()

    np.testing.assert_array_equal(deskewed(scan, STILL).points_body, before)
    deskewed(scan, TWIST)
    np.testing.assert_array_equal(scan.points_body, before)


def test_a_measured_rotation_moves_points_as_the_twist_that_it_samples():
    scan = swept()
    times_s = np.linspace(-0.04, 0.1, 8)
    R = np.array([TWIST.over(t)[:3, :3] for t in times_s])
    turning = Twist(TWIST.rotation_radps, np.zeros(3))
    shift = scan.times_s[:, np.newaxis] * np.array([1.0, 2.0, 3.0])
    found = deskewed(scan, SampledMotion(times_s, R, np.array([1.0, 2.0, 3.0])))
    np.testing.assert_allclose(found.points_body, deskewed(scan, turning).points_body + shift, atol=2e-5)


def test_a_scan_without_times_is_returned_as_it_is():
    scan = Scan(7, np.ones((3, 3), np.float32))

    assert deskewed(scan, TWIST) is scan


def test_the_twist_between_two_poses_leads_from_one_to_the_other():
    T_world_before = exp(np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]))
    T_world_after = T_world_before @ TWIST.over(0.25)

    found = twist_between(T_world_before, T_world_after, duration_s=0.25)

    np.testing.assert_allclose(found.rotation_radps, TWIST.rotation_radps, atol=1e-9)
    np.testing.assert_allclose(found.translation_mps, TWIST.translation_mps, atol=1e-9)


@pytest.mark.parametrize("index", [0, 2, 4])
def test_a_trajectory_of_constant_twist_tells_it_everywhere(index):
    stamps_ns = np.array([0, 100_000_000, 250_000_000, 300_000_000, 400_000_000])
    poses = np.array([TWIST.over(stamp_ns / 1e9) for stamp_ns in stamps_ns])

    found = twist_at(Trajectory(stamps_ns, poses), index)

    np.testing.assert_allclose(found.rotation_radps, TWIST.rotation_radps, atol=1e-9)


def test_a_single_pose_tells_of_no_motion():
    assert twist_at(Trajectory(np.array([5]), np.eye(4)[np.newaxis]), 0) is STILL
