"""Dilation of bit planes, against the same on a dense array."""

import numpy as np
import pytest

from mapper.octree.bit_planes import ALL_SET, NONE_SET, dilated, neighbours_of, words_of
from mapper.octree.keys import codes_of_blocks, gather


def dense(codes, plane, *, absent):
    """Return a (48, 48, 48) bool array of 6³ blocks, and the indices of the plane's voxels in it."""
    numbers = np.arange(512)
    local = np.column_stack([gather.py_func(numbers >> axis) for axis in range(3)])
    blocks = np.column_stack([gather.py_func(codes >> axis) for axis in range(3)])
    where = tuple((blocks[:, None] * 8 + local).reshape(-1, 3).T)
    voxels = np.full((48, 48, 48), absent)
    voxels[where] = np.unpackbits(plane, axis=1, bitorder="little").reshape(-1)
    return voxels, where


@pytest.mark.parametrize("absent", [NONE_SET, ALL_SET])
@pytest.mark.parametrize("density", [0.002, 0.5, 0.998])
def test_a_bit_is_set_where_one_of_27_is(absent, density):
    rng = np.random.default_rng(int(1000 * density))
    blocks = np.argwhere(rng.random((4, 4, 4)) < (0.6 if absent else 1.1)) + 1
    codes = np.sort(codes_of_blocks(blocks))
    plane = np.packbits(rng.random((len(codes), 512)) < density, axis=1, bitorder="little")
    before = plane.copy()

    grown = dilated(words_of(plane), neighbours_of(codes), absent=absent)

    voxels, where = dense(codes, plane, absent=bool(absent))
    expected = np.zeros_like(voxels)
    for shift in np.ndindex(3, 3, 3):
        expected |= np.roll(voxels, np.array(shift) - 1, axis=(0, 1, 2))
    np.testing.assert_array_equal(dense(codes, grown.view(np.uint8), absent=False)[0][where], expected[where])
    np.testing.assert_array_equal(plane, before)


def test_neighbours_at_the_ends_of_the_key_range_wrap_to_absent_blocks():
    codes = codes_of_blocks(np.array([[0, 0, 0], [8191, 8191, 8191]]))

    rows = neighbours_of(np.sort(codes))

    assert (rows == -1).all()
