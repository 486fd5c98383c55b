"""Wheel kinematics: from encoders to poses."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import inverse
from mapper.core.timebase import NS_PER_S as S
from mapper.core.trajectory import Trajectory
from mapper.sensing.wheel_kinematics import driven, pose_at, without_jumps
from tests.support.planar import arc, at


def test_a_held_wheel_drives_an_exact_arc_at_any_rate():
    wheelbase_m, steering_rad = 0.8, 0.3
    radius_m = wheelbase_m / np.tan(steering_rad)
    for n in (2, 7):
        path_m = np.linspace(5.0, 5.0 + radius_m * np.pi / 2.0, n)
        wheels = driven(
            np.arange(n, dtype=np.int64), path_m, np.full(n, steering_rad), wheelbase_m=wheelbase_m
        )
        np.testing.assert_allclose(wheels.T_world_body[0], np.eye(4), atol=0)
        quarter = at(radius_m, radius_m, np.pi / 2.0)
        np.testing.assert_allclose(wheels.T_world_body[-1], quarter, atol=1e-12)


def test_driving_back_the_same_path_ends_where_it_began():
    path_m = np.array([0.0, 1.0, 2.5, 1.0, 0.0])
    steering_rad = np.array([0.1, -0.3, 0.2, -0.3, 0.1])
    wheels = driven(np.arange(5, dtype=np.int64), path_m, steering_rad, wheelbase_m=0.5)
    np.testing.assert_allclose(wheels.T_world_body[-1], np.eye(4), atol=1e-12)


def test_poses_are_interpolated_but_never_guessed():
    wheels = arc(3)
    at = {stamp_ns: pose_at(wheels, stamp_ns, max_gap_ns=S // 10) for stamp_ns in (-1, 0, S // 40, S // 5)}
    assert at[-1] is None
    assert pose_at(wheels, S // 5 + 1, max_gap_ns=S) is None
    assert (at[0][0, 3], at[S // 5][0, 3]) == (0.0, 1.0)
    assert at[S // 40][0, 3] == pytest.approx(0.125)
    assert pose_at(wheels, S // 40, max_gap_ns=S // 10 - 1) is None


def test_odometry_that_is_restarted_goes_on():
    whole = arc(60, step_m=0.05, turn_rad=0.01)
    poses = whole.T_world_body.copy()
    poses[40:] = inverse(poses[40]) @ poses[40:]  # from the origin again
    continued, notes = without_jumps(replace(whole, T_world_body=poses))
    np.testing.assert_allclose(continued.T_world_body, whole.T_world_body, atol=1e-9)
    assert len(notes) == 1


def test_a_wrong_pose_between_right_ones_is_left_out():
    whole = arc(60, step_m=0.05)
    poses = whole.T_world_body.copy()
    poses[20, 1, 3] += 3.0
    continued, _ = without_jumps(replace(whole, T_world_body=poses))
    np.testing.assert_allclose(continued.T_world_body, whole.T_world_body, atol=1e-9)


@pytest.mark.parametrize("gap_s", [0.0001, 20.0])
def test_uneven_stamps_are_no_jump(gap_s):
    """Two messages at nearly one time; and 10 m in 20 s without any."""
    whole = arc(60, step_m=0.05)
    stamps_ns, poses = whole.stamps_ns.copy(), whole.T_world_body.copy()
    stamps_ns[30:] += round((gap_s - 0.1) * S)
    poses[30:, 0, 3] += 0.5 * gap_s
    uneven = Trajectory(stamps_ns, poses)
    assert without_jumps(uneven) == (uneven, [])
