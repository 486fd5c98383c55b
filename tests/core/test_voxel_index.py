import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from mapper.core.voxel_grid import thin
from mapper.core.voxel_index import cell_key, claim_row, row_of, voxel_index


@njit
def rows_of(index, keys):
    """Claim a row for each key, in order."""
    rows, count = np.empty(len(keys), np.int64), 0
    for i in range(len(keys)):
        rows[i] = claim_row(index, keys[i], count)
        count += rows[i] == count
    return rows


def rows_by_dictionary(keys):
    rows = {}
    return np.array([rows.setdefault(key, len(rows)) for key in keys.tolist()])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("spread", [1, 1 << 21, 1 << 42], ids=["z", "y", "x"])
def test_rows_number_the_keys_in_the_order_in_which_they_come(seed, spread):
    keys = np.random.default_rng(seed).integers(0, 300, 1000) * spread
    index = voxel_index(300)

    rows = rows_of(index, keys)

    np.testing.assert_array_equal(rows, rows_by_dictionary(keys))
    np.testing.assert_array_equal(index.keys[rows], keys)


def test_an_index_of_given_keys_finds_them_and_no_others():
    keys = np.random.default_rng(0).permutation(2000)[:1000] << 30
    index = voxel_index(1500, keys)

    assert [row_of(index, key) for key in keys] == list(range(1000))
    assert row_of(index, 1 << 60) == -1
    assert claim_row(index, 1 << 60, 1000) == 1000 == row_of(index, 1 << 60)


@pytest.mark.parametrize("capacity", [0, 1, 2])
def test_a_full_index_still_has_a_vacant_place(capacity):
    index = voxel_index(capacity, np.arange(capacity))

    assert row_of(index, 99) == -1


@pytest.mark.parametrize("seed", range(5))
def test_cells_have_one_key_each_on_both_sides_of_the_origin(seed):
    rng = np.random.default_rng(seed)
    cells = np.unique(rng.integers(-(1 << 20), 1 << 20, (500, 3)), axis=0)

    keys = {cell_key(*(cell + rng.uniform(0.0, 1.0, 3))) for cell in cells}

    assert len(keys) == len(cells)
    assert min(keys) >= 0


def test_no_axis_of_a_grid_crowds_the_table():
    """A hash that drops the bits of an axis makes runs of taken places as long as that axis."""
    for axis in range(3):
        cells = np.indices([400 if i == axis else 5 for i in range(3)]).reshape(3, -1).T
        index = voxel_index(len(cells), np.array([cell_key(*cell) for cell in cells.astype(float)]))
        vacant = np.flatnonzero(index.rows < 0)
        assert np.diff(vacant).max() < 100


@given(seed=st.integers(0, 1000), voxel_m=st.sampled_from([0.1, 0.5, 2.0]))
def test_keeps_the_first_point_of_every_voxel(seed, voxel_m):
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 3.0, (rng.integers(1, 400), 3)).astype(np.float32)
    cells = np.floor(points.astype(float) * (1.0 / voxel_m)).astype(int)
    _, first = np.unique(cells, axis=0, return_index=True)

    np.testing.assert_array_equal(thin(points, voxel_m), np.sort(first))


def test_of_nothing_nothing_is_kept():
    assert len(thin(np.empty((0, 3), np.float32), 0.2)) == 0
