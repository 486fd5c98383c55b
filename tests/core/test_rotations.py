import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapper.core.errors import DataError
from mapper.core.rotations import (
    euler_from_rotation,
    quaternion_from_rotation,
    rotation_from_euler,
    rotation_from_quaternion,
)

UNIT = st.floats(-1.0, 1.0)
ANGLE = st.floats(-np.pi, np.pi)
QUATERNIONS = st.tuples(UNIT, UNIT, UNIT, UNIT).map(np.array).filter(lambda q: np.linalg.norm(q) > 1e-3)


def turn(axis, angle_rad):
    """Right-handed turn about one axis, written from its definition."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


@given(QUATERNIONS)
def test_quaternion_there_and_back(q):
    R = rotation_from_quaternion(q)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    back = quaternion_from_rotation(R)
    assert back[3] >= 0.0
    assert np.linalg.norm(back) == pytest.approx(1.0)
    unit = q / np.linalg.norm(q)
    assert abs(float(back @ unit)) == pytest.approx(1.0, abs=1e-12), "the same up to sign"


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 0.3, np.pi / 2, 3.0, np.pi, -np.pi, -2.0])
def test_quaternion_of_a_turn_about_one_axis(axis, angle_rad):
    q = np.array([0.0, 0.0, 0.0, np.cos(angle_rad / 2)])
    q[axis] = np.sin(angle_rad / 2)
    np.testing.assert_allclose(rotation_from_quaternion(q), turn(axis, angle_rad), atol=1e-15)
    np.testing.assert_allclose(abs(quaternion_from_rotation(turn(axis, angle_rad)) @ q), 1.0, atol=1e-15)


@pytest.mark.parametrize(
    "q", [np.zeros(4), np.full(4, 1e-12), [np.nan, 0, 0, 1], np.full(4, np.inf), [0.0, -1e308, 0.0, 1.0]]
)
def test_a_quaternion_without_direction_is_refused(q):
    with pytest.raises(DataError, match="has no direction"):
        rotation_from_quaternion(np.array(q))


@given(ANGLE, ANGLE, ANGLE)
def test_euler_is_yaw_after_pitch_after_roll(roll, pitch, yaw):
    want = turn(2, yaw) @ turn(1, pitch) @ turn(0, roll)
    np.testing.assert_allclose(rotation_from_euler(roll, pitch, yaw), want, atol=1e-15)


@given(
    ANGLE,
    st.one_of(ANGLE, st.sampled_from([np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-6, -np.pi / 2 + 1e-9])),
    ANGLE,
)
def test_euler_angles_give_the_rotation_they_came_from(roll, pitch, yaw):
    R = rotation_from_euler(roll, pitch, yaw)
    found = euler_from_rotation(R)
    assert abs(found[1]) <= np.pi / 2
    np.testing.assert_allclose(rotation_from_euler(*found), R, atol=3e-6)  # what the gimbal's tolerance costs


@given(ANGLE, st.floats(-1.5, 1.5), ANGLE)
def test_euler_angles_away_from_the_gimbal_are_unique(roll, pitch, yaw):
    found = euler_from_rotation(rotation_from_euler(roll, pitch, yaw))
    turns = np.array(found) - [roll, pitch, yaw]
    np.testing.assert_allclose(np.sin(turns / 2), 0.0, atol=1e-12)


def test_at_the_gimbal_roll_is_zero():
    for pitch in (np.pi / 2, -np.pi / 2):
        roll, found, _ = euler_from_rotation(rotation_from_euler(0.4, pitch, 0.9))
        assert roll == 0.0
        assert found == pytest.approx(pitch)


def test_many_turns_are_converted_as_one_would_be():
    rng = np.random.default_rng(5)
    q = rng.normal(0, 1, (50, 4))
    rotations = rotation_from_quaternion(q)
    assert rotations.shape == (50, 3, 3)
    for one, R in zip(q, rotations, strict=True):
        np.testing.assert_array_equal(rotation_from_quaternion(one), R)
    back = quaternion_from_rotation(rotations)
    for R, one in zip(rotations, back, strict=True):
        np.testing.assert_allclose(quaternion_from_rotation(R), one, atol=1e-15)
    q[7] = 0.0
    with pytest.raises(DataError, match=r"\(0.0, 0.0, 0.0, 0.0\) has no direction"):
        rotation_from_quaternion(q)
