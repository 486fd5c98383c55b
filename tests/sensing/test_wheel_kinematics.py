"""Wheel kinematics: from encoders to poses."""

import numpy as np
import pytest

from mapper.core.timebase import NS_PER_S as S
from mapper.sensing.wheel_kinematics import driven, pose_at
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
