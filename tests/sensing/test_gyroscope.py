"""Gyroscope: integration of its angular velocities, gaps, and readings that are none."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapper.core.timebase import NS_PER_S
from mapper.sensing.gyroscope import Gyroscope
from mapper.sensing.gyroscope_kernels import rotation_vectors
from mapper.sensing.inertial import InertialReadings


def turning(*, seconds=2.0, rate_hz=200.0):
    """A gyroscope in a rotation R(t) = Rx(t²) Rz(3t), and that rotation."""
    times_s = np.arange(int(seconds * rate_hz) + 1) / rate_hz

    def rotation_at(t):
        return Rotation.from_rotvec([t * t, 0.0, 0.0]) * Rotation.from_rotvec([0.0, 0.0, 3.0 * t])

    rates = [Rotation.from_rotvec([0.0, 0.0, -3.0 * t]).apply([2.0 * t, 0.0, 0.0]) for t in times_s]
    rates = np.array(rates) + np.array([0.0, 0.0, 3.0])
    return Gyroscope("/imu", np.round(times_s * NS_PER_S).astype(np.int64), rates), rotation_at


def test_rotations_are_the_integral_of_the_rates():
    gyroscope, rotation_at = turning()
    begins_s, ends_s = np.array([0.0013, 0.5, 1.0]), np.array([1.7777, 0.5004, 1.0])
    begins_ns, ends_ns = (np.round(times_s * NS_PER_S).astype(np.int64) for times_s in (begins_s, ends_s))
    R, known = gyroscope.rotations(begins_ns, ends_ns, np.zeros(3))
    assert known.all()
    for begin_s, end_s, found in zip(begins_s, ends_s, R, strict=True):
        expected = (rotation_at(begin_s).inv() * rotation_at(end_s)).as_matrix()
        np.testing.assert_allclose(found, expected, atol=6e-5)


def test_a_bias_is_subtracted():
    gyroscope, _ = turning()
    bias = np.array([0.01, -0.02, 0.03])
    biased = Gyroscope("/imu", gyroscope.stamps_ns, gyroscope.rates_radps + bias)
    span = np.array([0]), np.array([NS_PER_S])
    np.testing.assert_allclose(
        biased.rotations(*span, bias)[0], gyroscope.rotations(*span, np.zeros(3))[0], atol=1e-12
    )


def test_rotations_over_gaps_and_beyond_the_ends_are_unknown():
    gyroscope, _ = turning()
    kept = (gyroscope.stamps_ns < 500_000_000) | (gyroscope.stamps_ns > 700_000_000)
    gapped = Gyroscope("/imu", gyroscope.stamps_ns[kept], gyroscope.rates_radps[kept])
    begins = np.array([0, 400_000_000, 800_000_000, 1_900_000_000, -1])
    known = gapped.rotations(begins, begins + 200_000_000, np.zeros(3))[1]
    assert known.tolist() == [True, False, True, False, False]
    assert len(gapped.without_faults()[1]) == 1


def test_readings_at_the_end_of_the_range_are_left_out():
    gyroscope, _ = turning()
    rates = np.clip(gyroscope.rates_radps, -2.5, 2.5)
    sound, notes = Gyroscope("/imu", gyroscope.stamps_ns, rates).without_faults()
    assert sound is None
    assert "2.5" in notes[0]
    rates = gyroscope.rates_radps.copy()
    rates[100:120, 0] = 9.0
    sound, notes = Gyroscope("/imu", gyroscope.stamps_ns, rates).without_faults()
    assert len(sound) == len(gyroscope) - 20
    assert len(notes) == 2


@pytest.mark.parametrize(("repeats", "left"), [(5, 401), (200, 201), (400, None)])
def test_readings_of_a_frozen_unit_are_left_out(repeats, left):
    gyroscope, _ = turning()
    rates = gyroscope.rates_radps.copy()
    rates[1 : 1 + repeats] = rates[0]
    sound, notes = Gyroscope("/imu", gyroscope.stamps_ns, rates).without_faults()
    assert (None if sound is None else len(sound)) == left
    assert len(notes) == (left != 401) + (left is None) + (left == 201)


def test_readings_that_a_driver_stamps_in_bursts_have_their_rate():
    gyroscope, _ = turning()
    bursts_ns = gyroscope.stamps_ns // 50_000_000 * 50_000_000 + gyroscope.stamps_ns % 50_000_000 // 50
    in_bursts = Gyroscope("/imu", bursts_ns, gyroscope.rates_radps)
    assert in_bursts.interval_ns == pytest.approx(gyroscope.interval_ns, rel=0.02)
    assert in_bursts.without_faults()[1] == []


def test_vectors_of_rotations_are_scipys():
    rng = np.random.default_rng(1)
    axes = rng.normal(size=(3000, 3))
    angles = np.concatenate(
        [rng.uniform(0.0, np.pi - 1e-6, 2000), 10.0 ** rng.uniform(-12.0, 0.0, 998), [0.0, np.pi - 1e-9]]
    )
    vectors = angles[:, None] * axes / np.linalg.norm(axes, axis=1)[:, None]
    np.testing.assert_allclose(
        rotation_vectors(Rotation.from_rotvec(vectors).as_matrix()), vectors, atol=1e-7
    )


def test_readings_between_two_times_lie_on_a_line():
    gyroscope, _ = turning()
    middle_ns = (gyroscope.stamps_ns[10:12].sum() // 2)[None]
    np.testing.assert_allclose(gyroscope.rates_at(middle_ns)[0], gyroscope.rates_radps[10:12].mean(axis=0))


MS = 1_000_000
STAMPS_NS = np.arange(0, 1000, 5, dtype=np.int64) * MS
READINGS = InertialReadings(
    STAMPS_NS,
    np.column_stack([np.sin(1e-9 * STAMPS_NS), np.ones(200), np.zeros(200)]),
    np.column_stack([np.zeros(200), np.cos(1e-9 * STAMPS_NS), np.full(200, 9.8)]),
    gap_ns=50 * MS,
)


@pytest.mark.parametrize(
    ("begin_ms", "end_ms", "is_covered"),
    [(0, 995, True), (-20, 1015, True), (-30, 500, False), (500, 1025, False)],
)
def test_readings_reach_half_a_gap_beyond_their_ends(begin_ms, end_ms, is_covered):
    assert READINGS.covers(begin_ms * MS, end_ms * MS) == is_covered


def test_the_first_reading_holds_before_it():
    rates, accelerations, seconds = READINGS.between(-20 * MS, 5 * MS)
    assert rates[0] == pytest.approx(READINGS.rates_radps[0])
    assert accelerations[0] == pytest.approx(READINGS.accelerations_mps2[0])
    assert seconds.sum() == pytest.approx(0.025)
