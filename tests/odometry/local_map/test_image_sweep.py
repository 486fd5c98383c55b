"""Motion within one image, and the covariance of poses by motion that was not taken out of them."""

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse, log
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.local_map.observation.image_sweep import SweepErrors, image_sweep
from mapper.registration.reprojection import residual

INTRINSICS = np.array([525.0, 520.0, 319.5, 239.5, 40.0])
HEIGHT_PX = 480
RATE_HZ = 10.0


def image(rng, sweep):
    """Return a pose, points, and their pixels in an image that was read while the camera moved by a sweep."""
    truth = exp(rng.normal(0.0, 0.05, 3), rng.normal(0.0, 0.1, 3))
    points, measured = rng.uniform([-1.2, -0.9, 1.0], [1.2, 0.9, 4.0], (300, 3)), np.zeros((300, 3))
    r = np.empty(3)
    for n, point in enumerate(points):
        phase = 0.0
        for _ in range(10):
            T_then = inverse(exp(phase * sweep[:3], phase * sweep[3:])) @ truth
            residual(T_then, point, np.zeros(3), INTRINSICS, r)
            measured[n] = -r
            phase = (measured[n, 1] + 0.5) / HEIGHT_PX - 0.5
        residual(truth, point, np.zeros(3), INTRINSICS, r)
        measured[n, 2] = -r[2]
    return truth, points, measured + rng.normal(0.0, 0.3, measured.shape)


def fitted(truth, points, measured):
    return image_sweep(truth, points, measured, np.full((len(points), 3), 0.3**-2), INTRINSICS, HEIGHT_PX)


def test_motion_within_an_image_is_found_with_its_information():
    rng, sweep = np.random.default_rng(0), np.array([0.006, -0.01, 0.008, 0.01, -0.008, 0.004])
    found, information, _ = fitted(*image(rng, sweep))
    error = found - sweep
    assert np.linalg.norm(error) < 0.5 * np.linalg.norm(sweep)
    assert error @ information @ error < 30.0  # chi-square of 6


def test_change_is_that_of_the_pose_if_the_motion_is_taken_for_none():
    rng, sweep = np.random.default_rng(1), np.array([0.02, 0.0, 0.0, 0.0, 0.03, 0.0])
    truth, points, measured = image(rng, sweep)
    _, _, change = fitted(truth, points, measured)
    T, r = truth.copy(), np.empty(3)

    def residuals(T):
        rows = []
        for point, pixel in zip(points, measured, strict=True):
            residual(T, point, pixel, INTRINSICS, r)
            rows.append(r.copy())
        return np.ravel(rows)

    for _ in range(3):  # the pose alone, by finite differences
        steps = 1e-6 * np.eye(6)
        J = np.column_stack([(residuals(exp(d[:3], d[3:]) @ T) - residuals(T)) / 1e-6 for d in steps])
        step = -np.linalg.lstsq(J, residuals(T), rcond=None)[0]
        T = exp(step[:3], step[3:]) @ T
    moved = np.concatenate(log(T @ inverse(truth)))
    assert np.linalg.norm(moved) > 0.005
    assert np.linalg.norm(np.abs(moved) - np.abs(change @ sweep)) < 0.2 * np.linalg.norm(moved)


def errors_of(sweep_of):
    """Return what a shaken camera's images tell; ``sweep_of`` gives a motion by velocity and position."""
    rng, errors = np.random.default_rng(2), SweepErrors()
    before = np.zeros(6)
    for k in range(120):
        times = np.array([k - 1, k]) / RATE_HZ
        position, last = (0.05 * np.sin(9.0 * t + np.arange(6)) for t in times[::-1])
        velocity = (position - last) * RATE_HZ
        true_velocity = 0.45 * np.cos(9.0 * times[1] + np.arange(6))
        errors.follow(velocity)
        motion = sweep_of(true_velocity, position) + rng.normal(0.0, 0.001, 6)
        errors.add((motion, 1e6 * np.eye(6), 0.5 * np.eye(6)), velocity, before)
    return errors


def test_motion_that_was_not_taken_out_is_the_pose_s_uncertainty():
    errors = errors_of(lambda velocity, _: 0.03 * velocity)
    assert errors.is_rolling
    expected_m = 0.5 * 0.03 * 0.45 / np.sqrt(2.0)
    assert np.allclose(np.sqrt(np.diag(errors.pose_covariance)), expected_m, rtol=0.3)
    errors.restart()
    assert not errors.pose_covariance.any()  # the motion in the next image is not known


@pytest.mark.parametrize(
    "sweep_of", [lambda velocity, _: 0.0 * velocity, lambda _, position: 0.3 * position], ids=["none", "lens"]
)
def test_other_errors_are_not_taken_for_a_rolling_shutter(sweep_of):
    errors = errors_of(sweep_of)
    assert not errors.is_rolling
    assert not errors.pose_covariance.any()


def test_covariance_of_a_frame_includes_that_of_its_shutter(frames):
    odometry = build_frame_odometry(LocalMapConfig())
    results = [odometry.track(odometry.observe(frame)) for frame in frames[:4]]
    assert np.all(np.diag(results[-1].covariance) < 1.0)
    odometry._shutter.pose_covariance = lambda _: np.eye(6)
    assert np.all(np.diag(odometry.track(odometry.observe(frames[4])).covariance) > 1.0)
