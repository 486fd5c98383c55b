"""Clusters of points."""

import numpy as np
import pytest

from mapper.core.clusters import cluster_numbers


def test_points_that_steps_connect_are_one_cluster():
    points = np.array([[9.0, 9.0], [0.0, 0.0], [2.0, 0.0], [1.0, 0.0], [9.0, 10.0]])
    assert cluster_numbers(points, 1.0).tolist() == [0, 1, 1, 1, 0]
    assert cluster_numbers(points, 0.9).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(("norm", "numbers"), [(2.0, [0, 1]), (np.inf, [0, 0])])
def test_the_norm_is_that_of_the_difference(norm, numbers):
    assert cluster_numbers(np.array([[0, 0], [2, 2]]), 2.0, norm=norm).tolist() == numbers


def test_no_points_have_no_cluster():
    assert cluster_numbers(np.zeros((0, 3)), 1.0).tolist() == []
