from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import Transform, exp, inverse
from mapper.core.rotations import quaternion_from_rotation
from mapper.sources.ros.frame_tree import FrameTree, is_of_wheels
from mapper.sources.ros.messages import PoseMessage

T_BASE_MAST = exp(np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]))
T_MAST_LIDAR = exp(np.array([-0.3, 0.1, 2.0]), np.array([0.0, 0.5, 0.1]))
T_BASE_IMU = exp(np.array([0.0, 0.0, 1.5]), np.array([0.2, 0.0, 0.0]))


def told(parent: str, child: str, T: Transform) -> PoseMessage:
    return PoseMessage(0, parent, child, (*T[:3, 3], *quaternion_from_rotation(T[:3, :3])))


TREE = FrameTree(
    [
        told("base", "/mast", T_BASE_MAST),
        told("/mast", "lidar", T_MAST_LIDAR),
        told("base", "imu", np.eye(4)),
        told("base", "imu", T_BASE_IMU),  # the last counts
        PoseMessage(0, "base", "broken", (0.0,) * 7),
        told("elsewhere", "other", np.eye(4)),
    ]
)


def test_frames_are_found_up_down_and_across():
    np.testing.assert_allclose(TREE.find("base", "lidar"), T_BASE_MAST @ T_MAST_LIDAR, atol=1e-12)
    np.testing.assert_allclose(TREE.find("lidar", "base"), inverse(T_BASE_MAST @ T_MAST_LIDAR), atol=1e-12)
    T_imu_lidar = inverse(T_BASE_IMU) @ T_BASE_MAST @ T_MAST_LIDAR
    np.testing.assert_allclose(TREE.find("imu", "/lidar"), T_imu_lidar, atol=1e-12)


def test_links_without_a_rigid_pose_are_named():
    assert TREE.damaged == ["base → broken"]


def test_of_static_frames_the_last_counts_and_contradictions_are_named_once():
    turned = told("base", "mast", T_BASE_MAST)
    turned = replace(turned, numbers=[*turned.numbers[:3], *(-q for q in turned.numbers[3:])])
    again = [turned, told("base", "imu", T_BASE_MAST), told("base", "imu", T_MAST_LIDAR)]
    no_pose = PoseMessage(0, "base", "imu", (0.0,) * 7)
    tree = FrameTree([told("base", "mast", T_BASE_MAST), told("base", "imu", T_BASE_IMU), *again, no_pose])
    assert (tree.contradicted, tree.damaged) == (["base → imu"], [])
    np.testing.assert_allclose(tree.find("base", "imu"), T_MAST_LIDAR, atol=1e-12)
    two_parents = FrameTree([told("base", "imu", T_BASE_IMU), told("mast", "imu", T_MAST_LIDAR)])
    assert two_parents.contradicted == ["imu in mast, not in base"]
    np.testing.assert_allclose(two_parents.find("mast", "imu"), T_MAST_LIDAR, atol=1e-12)


def test_of_moving_frames_the_first_of_one_stamp_counts():
    tree = FrameTree(
        replace(told("base", "arm", T), stamp_ns=stamp_ns)
        for stamp_ns, T in [(1, T_BASE_MAST), (2, T_BASE_IMU), (2, T_MAST_LIDAR)]
    )
    assert tree.contradicted == ["base → arm"]
    np.testing.assert_allclose(tree.find("base", "arm", stamp_ns=2), T_BASE_IMU, atol=1e-12)


def test_a_frame_is_itself_even_if_nobody_tells_of_it():
    np.testing.assert_array_equal(TREE.find("nobody", "nobody"), np.eye(4))


def test_what_nothing_connects_is_not_found():
    for frame in ("other", "broken", "nobody"):
        assert TREE.find("base", frame) is None


def test_a_circle_ends():
    circle = FrameTree([told("a", "b", np.eye(4)), told("b", "a", np.eye(4))])
    assert circle.find("a", "c") is None
    assert list(circle.frames) == ["a", "b"]


@pytest.mark.parametrize(
    ("frame", "is_wheels"),
    [
        ("odom", True),
        ("odom_combined", True),
        ("robot1/odom", True),
        ("camera_odom_frame", False),
        ("laser_odom", False),
        ("odometer_link", False),
    ],
)
def test_frames_of_wheel_odometry_are_known_by_their_words(frame, is_wheels):
    assert is_of_wheels(frame) == is_wheels
