"""Thinning keeps the first point of every voxel."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapper.core.voxel_grid import thin


@given(seed=st.integers(0, 1000), voxel_m=st.sampled_from([0.1, 0.5, 2.0]))
def test_keeps_the_first_point_of_every_voxel(seed, voxel_m):
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 3.0, (rng.integers(1, 400), 3)).astype(np.float32)
    cells = np.floor(points.astype(float) * (1.0 / voxel_m)).astype(int)
    _, first = np.unique(cells, axis=0, return_index=True)

    np.testing.assert_array_equal(thin(points, voxel_m), np.sort(first))


def test_of_nothing_nothing_is_kept():
    assert len(thin(np.empty((0, 3), np.float32), 0.2)) == 0


def test_cells_on_both_sides_of_the_origin_differ():
    points = np.array([[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0]], np.float32)

    assert thin(points, 0.2).tolist() == [0, 1]
