import numpy as np
import pytest

from mapper.core.errors import DataError, MapSizeError
from mapper.navigation.distance import distance_2d, distance_3d, signed_distances
from mapper.navigation.distance_transform import NONE, squares_to_boxes, squares_to_centres
from mapper.navigation.voxels import Box, cut_box, known_box
from mapper.octree.config import OctreeConfig
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.map import OctreeMap

SHAPES = [(1, 17, 30), (7, 5, 9), (1, 1, 20), (13, 1, 1), (9, 10, 18)]


def offsets(targets):
    """Return |cell − target| in cells, (cells, targets, 3)."""
    cells = np.indices(targets.shape).reshape(3, -1).T
    return np.abs(cells[:, np.newaxis] - np.argwhere(targets)[np.newaxis])


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("share", [0.01, 0.1, 0.6, 1.0])
def test_both_transforms_equal_brute_force(shape, share):
    targets = np.random.default_rng(sum(shape)).random(shape) < share
    targets.flat[0] = True

    to_centre = (offsets(targets) ** 2).sum(axis=2).min(axis=1)
    to_box = (np.maximum(2 * offsets(targets) - 1, 0) ** 2).sum(axis=2).min(axis=1)

    np.testing.assert_array_equal(squares_to_centres(targets).ravel(), to_centre)
    np.testing.assert_array_equal(squares_to_boxes(targets).ravel(), to_box)


def test_a_large_box_equals_scipy():
    ndimage = pytest.importorskip("scipy.ndimage", reason="the oracle for large boxes")
    targets = np.random.default_rng(1).random((40, 61, 83)) < 0.003
    expected = np.rint(ndimage.distance_transform_edt(~targets) ** 2)
    np.testing.assert_array_equal(squares_to_centres(targets), expected)


def test_no_target_has_its_own_value_and_never_overflows():
    assert (squares_to_centres(np.zeros((3, 4, 5), np.bool_)) == NONE).all()
    far = np.zeros((1, 12_000, 3), np.bool_)
    far[0, 0, 0] = True
    assert squares_to_boxes(far)[0, -1, 0] == (2 * 11_999 - 1) ** 2
    with pytest.raises(MapSizeError, match="1×13001×1 cells: an edge may have 13000"):
        squares_to_centres(np.zeros((1, 13_001, 1), np.bool_))


def grid_of(*rows):
    """Make a grid of 0.5 m from rows of text, the top row first: '#' occupied, '.' free, ' ' unknown."""
    codes = {"#": OCCUPIED, ".": FREE, " ": UNKNOWN}
    cells = np.array([[codes[letter] for letter in row] for row in rows[::-1]], np.int8)
    return OccupancyGrid(cells, np.array([1.0, 2.0]), 0.5)


def test_distances_on_a_grid_are_signed_and_end_at_the_surface():
    grid = grid_of(
        "....###",
        "....###",
        "....###",
    )
    got = distance_2d(grid, unknown_blocks=False)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got[1], [1.75, 1.25, 0.75, 0.25, -0.25, -0.75, -0.25])


def test_unknown_blocks_only_if_asked_and_surrounds_every_grid():
    grid = grid_of("..... ...#")
    np.testing.assert_allclose(
        distance_2d(grid, unknown_blocks=False)[0],
        0.5 * np.array([8.5, 7.5, 6.5, 5.5, 4.5, 3.5, 2.5, 1.5, 0.5, -0.5]),
    )
    blocked = distance_2d(grid, unknown_blocks=True)[0]
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


def test_a_box_of_the_octree_lies_where_it_was_asked_for(octree):
    voxels = cut_box(octree, Box(np.array([1.8, -0.1, 0.0]), np.array([2.2, 0.2, 0.1])), bytes_per_voxel=1)
    np.testing.assert_allclose(voxels.corner_world_m, [1.8, -0.1, 0.0], atol=1e-9)
    assert voxels.states.tolist() == [
        [
            [UNKNOWN] * 4,
            [FREE, FREE, OCCUPIED, UNKNOWN],
            [UNKNOWN] * 4,
        ]
    ]


def test_the_known_box_contains_every_voxel_and_a_margin(octree):
    box, centres = known_box(octree), octree.leaves().centres_world
    assert (box.low_world_m < centres.min(axis=0) - 0.1).all()
    assert (box.high_world_m > centres.max(axis=0) + 0.1).all()
    with pytest.raises(DataError, match="the map is empty"):
        known_box(OctreeMap(OctreeConfig()))


def test_a_field_interpolates_distance_and_gradient(octree):
    field = distance_3d(
        octree, Box(np.array([0.0, -1.0, -1.0]), np.array([3.0, 1.0, 1.0])), unknown_blocks=False
    )
    points = np.array([[1.0, 0.05, 0.05], [1.234, 0.05, 0.05], [2.75, 0.05, 0.05], [2.05, 0.05, 0.05]])

    np.testing.assert_allclose(field.distance(points), [1.0, 0.766, 0.65, -0.05], atol=1e-5)
    np.testing.assert_allclose(field.gradient(points)[:3, 0], [-1.0, -1.0, 1.0], atol=1e-5)
    np.testing.assert_allclose(field.gradient(points)[:2, 1:], 0.0, atol=0.02)  # a kink: one side's slope
    assert np.isnan(field.distance(np.array([[3.1, 0.0, 0.0], [0.0, -1.1, 0.0]]))).all()


def test_a_gradient_is_the_slope_of_its_own_field(octree):
    field = distance_3d(octree, known_box(octree), unknown_blocks=True)
    rng = np.random.default_rng(2)
    cells = rng.integers(2, np.array(field.distances_m.shape)[::-1] - 2, (200, 3)) + rng.uniform(
        0.1, 0.9, (200, 3)
    )
    points = field.corner_world_m + (cells + 0.5) * 0.1  # away from centres, where slopes change
    step = 1e-3
    slopes = [
        (field.distance(points + step * axis) - field.distance(points - step * axis)) / (2 * step)
        for axis in np.eye(3)
    ]
    np.testing.assert_allclose(field.gradient(points), np.column_stack(slopes), atol=2e-3)


def test_unknown_space_blocks_in_3d_only_if_asked(octree):
    box = Box(np.array([0.0, -0.3, -0.3]), np.array([1.0, 0.4, 0.4]))
    middle = np.array([[0.55, 0.05, 0.05]])
    assert distance_3d(octree, box, unknown_blocks=True).distance(middle) == pytest.approx(0.05)
    assert distance_3d(octree, box, unknown_blocks=False).distance(middle) == np.inf


def test_a_box_too_large_is_refused_with_the_estimate(octree):
    box = Box(np.array([-1000.0] * 3), np.array([1000.0] * 3))
    with pytest.raises(MapSizeError, match=r"20000×20000×20000 voxels needs 104308\.1 GiB .* limit is 2\.0"):
        distance_3d(octree, box, unknown_blocks=True)
    with pytest.raises(DataError, match=r"leaves ±3276\.8 m"):
        distance_3d(octree, Box(np.array([-1.0] * 3), np.array([9e3, 1.0, 1.0])), unknown_blocks=True)


@pytest.mark.parametrize(
    ("low", "high"),
    [([0, 0, 0], [1, 0, 1]), ([0, 0, np.nan], [1, 1, 1]), ([0, 0], [1, 1]), ([0] * 3, [np.inf] * 3)],
)
def test_boxes_check_themselves(low, high):
    with pytest.raises(DataError, match="box: "):
        Box(np.array(low, float), np.array(high, float))
