"""Poses by samples of pairs: the one that explains most of a scene, not most of the pairs."""

import numpy as np
import pytest

from mapper.core.geometry import apply, exp, inverse, log
from mapper.odometry.local_map.pose.sampled_poses import sampled_pose, shares_of_scene, support

INTRINSICS = np.array([525.0, 525.0, 319.5, 239.5, 40.0])
WEIGHTS = (0.3, 0.3, 0.5)
T_CAMERA_WORLD = exp(np.array([0.0, 0.02, 0.01]), np.array([0.05, 0.0, 0.02]))


def measured(points_camera, rng):
    """Return (N, 3) u, v and bf/z of points, with noise."""
    z = points_camera[:, 2:]
    pixels = points_camera[:, :2] / z * INTRINSICS[:2] + INTRINSICS[2:4]
    return np.column_stack([pixels, INTRINSICS[4] / z]) + rng.normal(0.0, WEIGHTS, (len(z), 3))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("on_person", [100, 200])
def test_a_room_outweighs_a_person_with_more_features(seed, on_person):
    rng = np.random.default_rng(seed)
    room = rng.uniform((-2.0, -1.2, 3.0), (2.0, 1.2, 5.0), (100, 3))
    person = rng.uniform((-0.3, -0.6, 1.8), (0.3, 0.8, 1.9), (on_person, 3))
    walked = apply(exp(np.zeros(3), np.array([0.1, 0.0, 0.0])), person)
    points = np.concatenate([room, person])
    seen = measured(apply(T_CAMERA_WORLD, np.concatenate([room, walked])), rng)
    weights = np.tile(np.array(WEIGHTS) ** -2.0, (len(points), 1))
    found = sampled_pose(np.eye(4), points, seen, weights, INTRINSICS, shares_of_scene(points))
    assert np.linalg.norm(log(found @ inverse(T_CAMERA_WORLD))[1]) < 0.02
    again = sampled_pose(np.eye(4), points, seen, weights, INTRINSICS, shares_of_scene(points))
    np.testing.assert_array_equal(found, again)


def test_points_near_each_other_share_one_place():
    points = np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 2.0], [0.0, 0.2, 2.0], [2.0, 0.0, 4.0]])
    np.testing.assert_allclose(shares_of_scene(points), [1 / 3, 1 / 3, 1 / 3, 1.0])


def test_a_compromise_has_less_support_than_a_pose_that_fits():
    points = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 2.0]])
    shares, weights = np.ones(2), np.ones((2, 3))
    exact = np.column_stack([points[:, :2] / 2.0 * 525.0 + INTRINSICS[2:4], [20.0, 20.0]])
    between = exact + np.array([[1.5, 0.0, 0.0], [-1.5, 0.0, 0.0]])
    beyond = exact + np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    pairs = points, weights, INTRINSICS, shares
    gains = [support(np.eye(4), pairs[0], m, *pairs[1:]) for m in (exact, beyond, between)]
    assert gains[0] == pytest.approx(2.0)
    assert gains[1] == pytest.approx(1.0)
    assert 1.0 < gains[2] < 1.5


def test_points_behind_the_camera_and_features_without_depth():
    points = np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 2.0]])
    seen = np.array([[319.5, 239.5, -20.0], [319.5, 239.5, np.nan]])
    assert support(np.eye(4), points, seen, np.ones((2, 3)), INTRINSICS, np.ones(2)) == pytest.approx(1.0)
