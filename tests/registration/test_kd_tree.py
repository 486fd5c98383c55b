"""The k-d tree against looking at every point."""

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.registration.kd_tree import kd_tree

RNG = np.random.default_rng(0)
CLOUDS = {
    "one": np.ones((1, 3)),
    "a leaf": RNG.normal(size=(8, 3)),
    "a leaf and one": RNG.normal(size=(9, 3)),
    "many": RNG.normal(size=(3000, 3)) * [30.0, 20.0, 1.0],
    "all alike": np.full((100, 3), 2.0),
    "on a grid": RNG.integers(0, 5, (700, 3)).astype(float),
    "on a line": np.outer(np.arange(50.0), [0.0, 1.0, 0.0]),
    "as read": RNG.normal(size=(500, 3)).astype(np.float32),
}


def all_distances(queries, points):
    return np.sort(np.linalg.norm(queries[:, None] - points[None], axis=2), axis=1)


@pytest.mark.parametrize("name", CLOUDS)
def test_the_nearest_points_are_those_of_a_search_of_all(name):
    points = CLOUDS[name]
    queries = np.concatenate([points[:40], RNG.uniform(-40.0, 40.0, (40, 3))]).astype(np.float64)
    count = min(7, len(points))
    tree = kd_tree(points)

    indices, distances_m = tree.nearest_few(queries, count)
    index, distance_m = tree.nearest(queries)

    assert np.allclose(distances_m, all_distances(queries, points)[:, :count], atol=1e-12)
    assert np.allclose(
        np.linalg.norm(tree.points[indices] - queries[:, None], axis=2), distances_m, atol=1e-12
    )
    assert all(len(set(row)) == count for row in indices)
    assert np.array_equal(distance_m, distances_m[:, 0])
    assert np.array_equal(index, indices[:, 0])


@pytest.mark.parametrize("name", CLOUDS)
def test_the_tree_holds_every_point_once_and_leaves_the_cloud_alone(name):
    points = CLOUDS[name]
    before = points.copy()
    ordered = kd_tree(points).points
    assert np.array_equal(points, before)
    assert np.array_equal(ordered[np.lexsort(ordered.T)], points[np.lexsort(points.T)])


def test_impossible_questions_are_refused():
    with pytest.raises(DataError, match="no points"):
        kd_tree(np.empty((0, 3)))
    with pytest.raises(DataError, match="4 nearest of 3 points"):
        kd_tree(np.eye(3)).nearest_few(np.zeros((1, 3)), 4)
