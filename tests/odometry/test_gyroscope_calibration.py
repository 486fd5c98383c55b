"""Calibration of a gyroscope by the turns of frames, and the prediction of rotations by it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapper.core.deskew import STILL
from mapper.core.geometry import rotation_exp
from mapper.core.timebase import NS_PER_S
from mapper.odometry.gyroscope_calibration import calibrate
from mapper.odometry.motion_prior import MotionPrior
from mapper.runtime.state_file import dumps, fixed_parts, loads
from mapper.sensing.gyroscope import Gyroscope

R_BODY_IMU = Rotation.from_rotvec([0.7, -1.9, 1.1]).as_matrix()
BIAS = np.array([0.02, -0.015, 0.01])
STEP_NS = NS_PER_S // 10


def swinging(seed, *, seconds=20.0, axes=(1.0, 1.0, 1.0), rms_radps=1.0):
    """Times at 1 kHz and orientations R_world_body of a body whose angular velocity is smooth noise."""
    rng = np.random.default_rng(seed)
    times_s = np.arange(round(1000 * seconds) + 1) / 1000.0
    rates = np.zeros((len(times_s), 3))
    for _ in range(12):
        hz, phase = rng.uniform(0.1, 1.5), rng.uniform(0.0, 2.0 * np.pi, 3)
        rates += rng.normal(size=3) * np.sin(2.0 * np.pi * hz * times_s[:, None] + phase)
    rates *= rms_radps * np.array(axes) / np.sqrt((rates**2).mean(axis=0))
    steps = Rotation.from_rotvec(0.5e-3 * (rates[1:] + rates[:-1])).as_matrix()
    R = [np.eye(3)]
    for step in steps:
        R.append(R[-1] @ step)
    return times_s, rates, np.array(R)


def readings(times_s, rates, *, offset_s=0.012, R_body_imu=R_BODY_IMU, flip=(1, 1, 1), unit=1.0, stated=None):
    rng = np.random.default_rng(5)
    measured = (rates @ R_body_imu + BIAS)[::5] * np.array(flip) * unit
    measured = measured + 0.003 * unit * rng.standard_normal(measured.shape)
    stamps_ns = np.round((times_s[::5] + offset_s) * NS_PER_S).astype(np.int64)
    return Gyroscope("/imu", stamps_ns, measured, stated)


def frames(times_s, R, *, noise_rad=1e-3):
    """Frames at 10 Hz: their stamps and orientations as an odometry measures them."""
    rng = np.random.default_rng(6)
    indices = np.arange(500, len(times_s) - 500, 100)
    noisy = R[indices] @ Rotation.from_rotvec(noise_rad * rng.standard_normal((len(indices), 3))).as_matrix()
    return np.round(times_s[indices] * NS_PER_S).astype(np.int64), noisy


def calibrated(gyroscope, stamps_ns, R):
    return calibrate(gyroscope, stamps_ns[:-1], stamps_ns[1:], R[:-1].transpose(0, 2, 1) @ R[1:])


def angle_rad(R, other):
    return Rotation.from_matrix(R.T @ other).magnitude()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("offset_s", [-0.1, 0.0, 0.05])
def test_mounting_bias_and_offset_are_found_within_their_uncertainty(seed, offset_s):
    times_s, rates, R = swinging(seed)
    found = calibrated(readings(times_s, rates, offset_s=offset_s), *frames(times_s, R))
    sigmas = np.sqrt(np.diag(found.covariance))
    assert angle_rad(found.R_body_imu, R_BODY_IMU) < 4.0 * np.linalg.norm(sigmas[:3]) < 0.02
    assert np.linalg.norm(found.bias - BIAS) < 4.0 * np.linalg.norm(sigmas[3:6]) < 0.02
    assert abs(found.offset_s - offset_s) < 4.0 * sigmas[6] < 0.004
    assert found.scale == 1.0


@pytest.mark.parametrize("rms_radps", [0.3, 1.0])
@pytest.mark.parametrize("unit", [1.0, 180.0 / np.pi])
def test_the_first_turn_is_predicted_in_either_unit_by_a_stated_mounting(unit, rms_radps):
    times_s, rates, R = swinging(4, rms_radps=rms_radps)
    prior = MotionPrior(readings(times_s, rates, offset_s=0.0, unit=unit, stated=R_BODY_IMU))
    stamps_ns, R_world_body = frames(times_s, R)
    predicted = prior.turn(*stamps_ns[3:5].tolist())
    assert angle_rad(predicted, R_world_body[3].T @ R_world_body[4]) < 0.01


def test_degrees_and_left_handed_axes_are_recognised():
    times_s, rates, R = swinging(4)
    found = calibrated(readings(times_s, rates, unit=180.0 / np.pi), *frames(times_s, R))
    assert found.scale == pytest.approx(np.pi / 180.0)
    assert angle_rad(found.R_body_imu, R_BODY_IMU) < 0.01
    found = calibrated(readings(times_s, rates, flip=(1, -1, 1)), *frames(times_s, R))
    assert found.scale == -1.0
    mirrored = -R_BODY_IMU @ np.diag([1.0, -1.0, 1.0])
    assert angle_rad(found.R_body_imu, mirrored) < 0.01


def test_what_one_axis_does_not_show_stays_uncertain():
    times_s, rates, R = swinging(7, axes=(1e-3, 1e-3, 1.0))
    found = calibrated(readings(times_s, rates), *frames(times_s, R))
    sigmas = np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3]))
    assert sigmas[0] < 0.01
    assert sigmas[2] > 0.3


def predictions(gyroscope, stamps_ns, R):
    """Errors of a prior's predicted rotations, whether it used the gyroscope, and the prior."""
    prior, errors, used = MotionPrior(gyroscope), [], []
    R_last = np.eye(3)
    for k in range(len(stamps_ns) - 1):
        begin_ns, end_ns = int(stamps_ns[k]), int(stamps_ns[k + 1])
        R_true = R[k].T @ R[k + 1]
        turn = prior.turn(begin_ns, end_ns)
        used.append(turn is not None)
        errors.append(angle_rad(R_last if turn is None else turn, R_true))
        prior.learn(begin_ns, end_ns, R_true, R_last)
        R_last = R_true
    return np.array(errors), np.array(used), prior


def test_an_uncalibrated_gyroscope_predicts_from_when_the_motion_has_shown_its_mounting():
    times_s, rates, R = swinging(8)
    stamps_ns, noisy = frames(times_s, R)
    errors, used, prior = predictions(readings(times_s, rates), stamps_ns, noisy)
    assert not used[:8].any()
    assert used[30:].all()
    assert np.median(errors[30:]) < 0.004
    assert any("found from the log" in note for note in prior.notes())


def test_a_stated_mounting_is_used_from_the_start_and_a_wrong_one_is_found_out():
    times_s, rates, R = swinging(9)
    stamps_ns, noisy = frames(times_s, R)
    errors, used, _ = predictions(readings(times_s, rates, stated=R_BODY_IMU), stamps_ns, noisy)
    assert used.all()
    assert np.median(errors[:8]) < 0.03  # the offset is not known yet
    wrong = readings(times_s, rates, stated=np.diag([1.0, -1.0, -1.0]) @ R_BODY_IMU)
    errors, used, prior = predictions(wrong, stamps_ns, noisy)
    assert np.median(errors[30:]) < 0.004
    assert any("180°" in note for note in prior.notes())


def test_a_gyroscope_that_contradicts_the_frames_is_not_used():
    times_s, rates, _ = swinging(10)
    _, _, other = swinging(11)
    _, used, prior = predictions(readings(times_s, rates), *frames(times_s, other))
    assert used.mean() < 0.05
    assert len(prior.notes()) >= 1


def test_a_rotation_is_rejected_that_the_gyroscope_rules_out():
    times_s, rates, R = swinging(15)
    stamps_ns, noisy = frames(times_s, R)
    begin_ns, end_ns = int(stamps_ns[0]), int(stamps_ns[1])
    R_true = R[0].T @ R[1]
    wrong = R_true @ rotation_exp(np.array([0.0, 0.0, 0.5]))
    _, _, prior = predictions(readings(times_s, rates), stamps_ns, noisy)
    assert prior.reject(begin_ns, end_ns, wrong)
    assert not prior.reject(begin_ns, end_ns, R_true @ rotation_exp(np.array([0.0, 0.0, 0.1])))
    assert not MotionPrior(readings(times_s, rates)).reject(begin_ns, end_ns, wrong)  # not calibrated yet
    _, _, other = swinging(16)
    _, _, unrelated = predictions(readings(times_s, rates), *frames(times_s, other))
    assert not unrelated.reject(begin_ns, end_ns, wrong)
    slow = Rotation.from_rotvec(np.outer(0.02 * np.arange(40), [0.0, 0.0, 1.0])).as_matrix()
    _, used, unused = predictions(readings(times_s, 0.0 * rates), stamps_ns[:40], slow)
    assert not used[8:].any()  # constant velocity predicts all of it, and a gyroscope that is still little
    assert not unused.reject(begin_ns, end_ns, rotation_exp(np.array([0.0, 0.0, 1.5])))


def test_a_gyroscope_that_has_become_wrong_soon_rejects_nothing():
    times_s, rates, R = swinging(17)
    stamps_ns, noisy = frames(times_s, R)
    _, _, prior = predictions(readings(times_s, rates), stamps_ns, noisy)
    turned = rotation_exp(np.array([0.0, 0.0, 0.5]))
    rejected = [
        prior.reject(int(stamps_ns[k]), int(stamps_ns[k + 1]), R[k].T @ R[k + 1] @ turned) for k in range(30)
    ]
    assert rejected[0]
    assert not rejected[-1]
    assert sum(rejected) < 20


def test_frames_that_are_lost_do_not_take_away_the_calibration():
    times_s, rates, R = swinging(17)
    stamps_ns, noisy = frames(times_s, R)
    _, _, prior = predictions(readings(times_s, rates), stamps_ns, noisy)
    turned = rotation_exp(np.array([0.0, 0.0, 0.5]))
    steps = [(int(stamps_ns[k]), int(stamps_ns[k + 1]), noisy[k].T @ noisy[k + 1]) for k in range(32)]
    for begin_ns, end_ns, R_begin_end in steps[:30]:
        prior.reject(begin_ns, end_ns, R_begin_end @ turned)
    assert prior.calibration is not None
    assert prior.turn(*steps[0][:2]) is not None
    assert not prior.reject(*steps[30])
    begin_ns, end_ns, R_begin_end = steps[31]
    assert prior.reject(begin_ns, end_ns, R_begin_end @ turned)


def test_a_gyroscope_of_another_clock_is_named():
    times_s, rates, R = swinging(14)
    _, used, prior = predictions(readings(times_s, rates, offset_s=1000.0), *frames(times_s, R))
    assert not used.any()
    assert [note for note in prior.notes() if "clock" in note] == prior.notes()


@pytest.mark.parametrize("offset_s", [3.0, -4.5])
def test_a_clock_that_is_seconds_off_is_named_with_the_setting_that_corrects_it(offset_s):
    times_s, rates, R = swinging(14)
    _, _, prior = predictions(
        readings(times_s, rates, offset_s=offset_s, unit=180.0 / np.pi), *frames(times_s, R)
    )
    assert sum(f"source.imu_offset_s={-offset_s:.2f}" in note for note in prior.notes()) == 1
    for right_s in (0.012, 0.5):  # which the calibration finds
        _, _, prior = predictions(readings(times_s, rates, offset_s=right_s), *frames(times_s, R))
        assert not any("source.imu_offset_s" in note for note in prior.notes())
    _, _, other = swinging(15)
    _, _, unrelated = predictions(readings(times_s, rates), *frames(times_s, other))
    assert not any("source.imu_offset_s" in note for note in unrelated.notes())


def test_without_a_gyroscope_the_velocity_stays():
    prior = MotionPrior(None)
    np.testing.assert_array_equal(prior.predict(0, NS_PER_S, STILL, np.ones(3)), np.eye(4))
    assert prior.sweep(0, 0.05, np.zeros(3)) is None
    assert prior.notes() == []


def test_a_sweep_turns_as_the_body_does():
    times_s, rates, R = swinging(12)
    stamps_ns, noisy = frames(times_s, R)
    _, _, prior = predictions(readings(times_s, rates), stamps_ns, noisy)
    velocity = np.array([1.0, 0.5, 0.0])
    motion = prior.sweep(10 * NS_PER_S, 0.05, velocity)
    for tau_s in (-0.05, -0.031, 0.0, 0.0173, 0.05):
        T = motion.over(tau_s)
        expected = R[10_000].T @ R[10_000 + round(1000 * tau_s)]
        assert angle_rad(T[:3, :3], expected) < 2.5e-3
        np.testing.assert_allclose(T[:3, 3], tau_s * velocity, atol=1e-12)
    shifted = motion.about(0.02)
    expected = np.linalg.inv(motion.over(0.02)) @ motion.over(0.03)
    np.testing.assert_allclose(shifted.over(0.01), expected, atol=1e-9)


def test_a_prior_goes_on_from_its_state_without_the_readings_in_it():
    times_s, rates, R = swinging(13)
    stamps_ns, noisy = frames(times_s, R)
    _, _, prior = predictions(readings(times_s, rates), stamps_ns[:60], noisy[:60])
    fixed = fixed_parts(prior, (Gyroscope,))
    assert prior.sweep(int(stamps_ns[30]), 0.05, np.zeros(3)) is not None
    data = dumps(prior, fixed=fixed)
    again = loads(data, fixed=fixed)
    assert len(data) < 100_000
    for one in (prior, again):
        for k in range(60, 99):
            R_k = noisy[k].T @ noisy[k + 1]
            one.learn(int(stamps_ns[k]), int(stamps_ns[k + 1]), R_k, np.eye(3))
    span = int(stamps_ns[99]), int(stamps_ns[100])
    np.testing.assert_array_equal(prior.turn(*span), again.turn(*span))
