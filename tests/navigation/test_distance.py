import numpy as np
import pytest

from mapper.core.errors import DataError, MapSizeError
from mapper.navigation.distance import (
    NONE,
    dense_voxels,
    distance_field,
    layer,
    plane_distances,
    signed_distances,
    squares_to_boxes,
)
from mapper.octree.config import OctreeConfig
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.map import OctreeMap

SHAPES = [(1, 17, 30), (7, 5, 9), (1, 1, 20), (13, 1, 1), (9, 10, 18)]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("share", [0.01, 0.1, 0.6, 1.0])
def test_squares_to_boxes_equal_brute_force(shape, share):
    targets = np.random.default_rng(sum(shape)).random(shape) < share
    targets.flat[0] = True

    cells = np.indices(shape).reshape(3, -1).T
    offsets = np.abs(cells[:, np.newaxis] - np.argwhere(targets)[np.newaxis])
    expected = (np.maximum(2 * offsets - 1, 0) ** 2).sum(axis=2).min(axis=1)
    np.testing.assert_array_equal(squares_to_boxes(targets).ravel(), expected)


def test_no_target_has_its_own_value_and_never_overflows():
    assert (squares_to_boxes(np.zeros((3, 4, 5), np.bool_)) == NONE).all()
    assert (plane_distances(np.zeros((2, 3), np.bool_)) == np.inf).all()
    far = np.zeros((1, 12_000, 3), np.bool_)
    far[0, 0, 0] = True
    assert squares_to_boxes(far)[0, -1, 0] == (2 * 11_999 - 1) ** 2
    with pytest.raises(MapSizeError, match="13000"):
        squares_to_boxes(np.zeros((1, 13_001, 1), np.bool_))


def distances_of(*rows, unknown_blocks):
    """Distances in cells of 0.5 m from rows of text, the top row first: '#' occupied, '.' free."""
    codes = {"#": OCCUPIED, ".": FREE, " ": UNKNOWN}
    cells = np.array([[codes[letter] for letter in row] for row in rows[::-1]], np.int8)
    voxels = layer(OccupancyGrid(cells, np.array([1.0, 2.0]), 0.5))
    return distance_field(voxels, unknown_blocks=unknown_blocks).distances_m[0, 1:-1, 1:-1]


def test_distances_on_a_grid_are_signed_and_end_at_the_surface():
    got = distances_of("....###", "....###", "....###", unknown_blocks=False)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got[1], [1.75, 1.25, 0.75, 0.25, -0.25, -0.75, -0.25])


def test_unknown_blocks_only_if_asked_and_surrounds_every_grid():
    np.testing.assert_allclose(
        distances_of("..... ...#", unknown_blocks=False)[0],
        0.5 * np.array([8.5, 7.5, 6.5, 5.5, 4.5, 3.5, 2.5, 1.5, 0.5, -0.5]),
    )
    blocked = distances_of("..... ...#", unknown_blocks=True)[0]
    np.testing.assert_allclose(blocked[:5], 0.25)  # the rows above and below the only one are unknown


def test_everything_and_nothing_are_infinitely_far():
    assert (signed_distances(np.zeros((1, 2, 2), np.bool_), 0.1) == np.inf).all()
    assert (signed_distances(np.ones((1, 2, 2), np.bool_), 0.1) == -np.inf).all()


@pytest.fixture
def octree():
    """A free corridor along x from −1 to 2 m that ends at an occupied voxel."""
    octree = OctreeMap(OctreeConfig(resolution_m=0.1, max_range_m=20.0))
    octree.insert_points(np.array([[2.05, 0.05, 0.05]], np.float32), np.array([-0.95, 0.05, 0.05]))
    return octree


def test_dense_voxels_have_the_states_of_the_map_and_a_margin(octree):
    voxels = dense_voxels(octree, bytes_per_voxel=1)
    z, y, x = np.indices(voxels.states.shape).reshape(3, -1)
    centres = voxels.corner_world_m + (np.column_stack([x, y, z]) + 0.5) * 0.1
    np.testing.assert_array_equal(voxels.states.ravel(), octree.query(centres))
    known = centres[voxels.states.ravel() != UNKNOWN]
    assert len(known) == len(octree)
    assert (voxels.states[[0, -1]] == UNKNOWN).all()
    with pytest.raises(DataError, match="the map is empty"):
        dense_voxels(OctreeMap(OctreeConfig()), bytes_per_voxel=1)


def test_a_field_interpolates_between_centres(octree):
    field = distance_field(dense_voxels(octree, bytes_per_voxel=1), unknown_blocks=False)
    points = np.array([[1.0, 0.05, 0.05], [1.234, 0.05, 0.05], [2.35, 0.05, 0.05], [2.05, 0.05, 0.05]])
    np.testing.assert_allclose(field.distance(points), [1.0, 0.766, 0.25, -0.05], atol=1e-5)
    assert np.isnan(field.distance(np.array([[3.1, 0.0, 0.0], [0.0, -1.1, 0.0]]))).all()


@pytest.mark.parametrize(("unknown_blocks", "distance_m"), [(True, 0.05), (False, 1.45)])
def test_unknown_space_blocks_in_3d_only_if_asked(octree, unknown_blocks, distance_m):
    field = distance_field(dense_voxels(octree, bytes_per_voxel=1), unknown_blocks=unknown_blocks)
    assert field.distance(np.array([[0.55, 0.05, 0.05]])) == pytest.approx(distance_m)
