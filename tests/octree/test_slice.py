from itertools import pairwise

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.core.frames import Scan
from mapper.octree.config import OctreeConfig, SliceConfig
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, overlap_of, shrunk
from mapper.octree.keys import KEY_ZERO
from mapper.octree.map import OctreeMap
from mapper.octree.occupied_columns import NOWHERE, DrivenGround, block_extent, ground_heights
from mapper.octree.slice import Band, cut_slice
from tests.support.grids import state_at

CELL = 0.05


def scanned(points, origin=(0.025, 0.025, 0.525), *, octree=None):
    octree = octree or OctreeMap(OctreeConfig(max_range_m=20.0))
    octree.insert_points(np.asarray(points, np.float32), np.asarray(origin))
    return octree


def wall(start, end, *, z=(0.525,)):
    """Points every 2 cm along a wall seen from above, at the given heights."""
    start, end = np.array(start), np.array(end)
    n = int(np.linalg.norm(end - start) / 0.02) + 1
    line = start + np.linspace(0.0, 1.0, n)[:, np.newaxis] * (end - start)
    return np.vstack([np.column_stack([line, np.full(n, height)]) for height in z])


def test_an_l_shaped_room_lies_the_right_way_round():
    # The L is 4 m × 3 m without its corner of high x and high y.
    corners = [(-1.0, -1.0), (3.0, -1.0), (3.0, 0.5), (1.0, 0.5), (1.0, 2.0), (-1.0, 2.0), (-1.0, -1.0)]
    points = np.vstack([wall(a, b) for a, b in pairwise(corners)])
    octree = scanned(points + np.array([0.025, 0.025, 0.0]))

    grid = cut_slice(octree, SliceConfig())

    np.testing.assert_allclose(grid.origin_world_m, [-1.0, -1.0], atol=1e-9)
    assert grid.cells.shape == (61, 81)  # rows are y, columns are x
    for x, y in corners:
        assert state_at(grid, x + 0.025, y + 0.025) == OCCUPIED
    assert state_at(grid, 2.5, -0.5) == FREE  # along x
    assert state_at(grid, -0.5, 1.5) == FREE  # along y
    assert state_at(grid, 2.5, 1.5) == UNKNOWN  # the missing corner
    assert (grid.cells[0] == OCCUPIED).all()  # row 0 is the wall of lowest y
    assert (grid.cells[:, 0] == OCCUPIED).all()
    assert (grid.cells[-1, 50:] == UNKNOWN).all()


def test_occupied_beats_free_beats_unknown():
    ahead = [1.025, 0.025, 0.525]
    octree = scanned([ahead])
    scanned([[2.025, 0.025, 0.725]], (0.025, 0.025, 0.725), octree=octree)  # free above the first end

    grid = cut_slice(octree, SliceConfig())

    assert state_at(grid, 1.025, 0.025) == OCCUPIED
    assert state_at(grid, 1.525, 0.025) == FREE
    assert grid.cells.tolist() == [[FREE] * 20 + [OCCUPIED] + [FREE] * 19 + [OCCUPIED]]


@pytest.mark.parametrize(
    ("height_m", "inside"), [(0.075, False), (0.125, True), (0.475, True), (0.525, False), (-0.475, False)]
)
def test_the_band_is_measured_from_the_floor(height_m, inside):
    floor_z_m = -1.3
    origin = [0.025, 0.025, floor_z_m + 0.3]
    octree = scanned([[1.025, 0.025, floor_z_m + 0.275], [1.225, 0.025, floor_z_m + height_m]], origin)

    band = Band(SliceConfig(min_height_m=0.1, max_height_m=0.5), CELL, floor_z_m)
    first, last = block_extent(octree)
    shape = int(last[1] - first[1]), int(last[0] - first[0])
    grid = band.grid_of(band.flags(octree, first=first, shape=shape, ground_m=None), first=first)

    assert (grid.cells == OCCUPIED).sum() == 1 + inside


def test_without_speckles_their_columns_other_voxels_count():
    octree = scanned(wall((1.025, -0.5), (1.025, 0.5)))
    scanned([[0.525, 0.025, 0.725]], (0.525, 0.025, 1.0), octree=octree)  # a speck over free space
    scanned([[1.525, 1.525, 0.325]], (1.525, 1.525, 0.325), octree=octree)  # one in the unknown

    every = cut_slice(octree, SliceConfig())
    clean = cut_slice(octree, SliceConfig(min_cluster_cells=2))

    assert state_at(every, 0.525, 0.025) == state_at(every, 1.525, 1.525) == OCCUPIED
    assert state_at(clean, 0.525, 0.025) == FREE
    assert state_at(clean, 1.525, 1.525) == UNKNOWN
    assert state_at(clean, 1.025, 0.025) == OCCUPIED
    assert (clean.cells == OCCUPIED).sum() == (every.cells == OCCUPIED).sum() - 2


@pytest.mark.parametrize(
    "octree", [OctreeMap(OctreeConfig()), scanned([[1.0, 0.0, 0.5]])], ids=["empty", "above"]
)
def test_a_band_in_which_nothing_is_known_is_refused(octree):
    with pytest.raises(DataError, match=r"nothing is known 1 to 2 m above the floor at z = 0 m"):
        cut_slice(octree, SliceConfig(min_height_m=1.0, max_height_m=2.0))


def test_a_band_thinner_than_a_voxel_is_refused():
    with pytest.raises(DataError, match=r"no voxel of 0\.05 m has its centre 0\.1 to 0\.12 m"):
        cut_slice(scanned([[1.0, 0.0, 0.5]]), SliceConfig(min_height_m=0.1, max_height_m=0.12))


@pytest.mark.parametrize(
    ("cells", "origin", "resolution_m", "message"),
    [
        (np.full((2, 2), 50, np.int8), np.zeros(2), 0.05, r"codes \[50\]"),
        (np.zeros((2, 2), np.int16), np.zeros(2), 0.05, "int16"),
        (np.zeros((0, 2), np.int8), np.zeros(2), 0.05, "of some size"),
        (np.zeros(4, np.int8), np.zeros(2), 0.05, r"\(4,\)"),
        (np.zeros((2, 2), np.int8), np.zeros(3), 0.05, "two finite numbers"),
        (np.zeros((2, 2), np.int8), np.array([0.0, np.nan]), 0.05, "two finite numbers"),
        (np.zeros((2, 2), np.int8), np.array([0.0, 1.0]), 1e-320, "in cells of"),
        (np.zeros((2, 2), np.int8), np.zeros(2), 0.0, "resolution 0"),
    ],
)
def test_a_grid_checks_itself_at_birth(cells, origin, resolution_m, message):
    with pytest.raises(DataError, match=message):
        OccupancyGrid(cells, origin, resolution_m)


def test_a_shrunk_grid_shows_what_matters_most():
    cells = np.full((5, 7), UNKNOWN, np.int8)
    cells[0, :4], cells[1, 1], cells[4, 6] = FREE, OCCUPIED, OCCUPIED

    small = shrunk(OccupancyGrid(cells, np.array([1.0, -2.0]), 0.5), 4)

    np.testing.assert_array_equal(small.cells, [[OCCUPIED, FREE, -1, -1], [-1] * 4, [-1, -1, -1, OCCUPIED]])
    assert small.resolution_m == 1.0
    np.testing.assert_array_equal(small.origin_world_m, [1.0, -2.0])
    assert shrunk(small, 4) is small


@pytest.mark.parametrize("corner", [(-1, -2), (0, 0), (3, 1), (-9, 0), (1, 9)])
def test_a_window_and_an_array_share_the_cells_where_they_overlap(corner):
    array, window = np.zeros((4, 5)), np.arange(1, 7).reshape(2, 3)
    inside, own = overlap_of(corner, window.shape, array.shape)
    array[inside] = window[own]
    padded = np.zeros((40, 40))
    padded[20 + corner[0] : 22 + corner[0], 20 + corner[1] : 23 + corner[1]] = window
    np.testing.assert_array_equal(array, padded[20:24, 20:25])


SLOPE = 0.1


@pytest.fixture(scope="module")
def hill():
    """A road that rises by a tenth, seen from above the road, with a wall beside it."""
    octree = OctreeMap(OctreeConfig(resolution_m=0.2, max_range_m=80.0))
    x, y = np.meshgrid(np.arange(-20.0, 20.0, 0.15), np.arange(-8.0, 8.0, 0.15))
    road = np.column_stack([x.ravel(), y.ravel(), SLOPE * x.ravel()])
    along, up = np.meshgrid(np.arange(-20.0, 20.0, 0.15), np.arange(0.0, 3.0, 0.15))
    wall = np.column_stack([along.ravel(), np.full(along.size, 8.0), SLOPE * along.ravel() + up.ravel()])
    for x_m in np.arange(-18.0, 19.0, 3.0):
        origin = np.array([x_m, 0.0, SLOPE * x_m + 1.7])
        points = np.concatenate([road, wall])
        near = np.abs(points[:, 0] - x_m) < 6.0
        octree.insert(Scan(0, (points[near] - origin).astype(np.float32)), at(origin))
    return octree


def at(position):
    pose = np.eye(4)
    pose[:3, 3] = position
    return pose


def test_the_ground_is_found_under_every_column(hill):
    first = np.array([KEY_ZERO - 100, KEY_ZERO - 40])

    ground_m = ground_heights(hill, first=first, shape=(80, 200), floor_z_m=0.0)

    columns = (np.arange(200) - 100 + 0.5) * 0.2
    miss_m = ground_m[40] - SLOPE * columns
    assert np.abs(miss_m[10:-10]).max() < 0.3


def test_a_slice_that_follows_the_ground_shows_the_wall_and_no_road(hill):
    band = {"min_height_m": 0.5, "max_height_m": 1.5}
    level = cut_slice(hill, SliceConfig(**band))
    following = cut_slice(hill, SliceConfig(**band, above="ground"))

    for x_m in (-15.0, -5.0, 5.0, 15.0):
        assert state_at(following, x_m, 0.0) == FREE
        assert state_at(following, x_m, 8.1) == OCCUPIED
    assert state_at(level, 10.0, 0.0) == OCCUPIED  # the road itself is a metre above the floor there


def test_where_no_floor_is_seen_the_band_is_level(hill):
    ground_m = ground_heights(hill, first=np.array([KEY_ZERO + 500, KEY_ZERO]), shape=(20, 20), floor_z_m=0.7)

    np.testing.assert_array_equal(ground_m, np.full((20, 20), 0.7))


def test_floor_of_a_few_columns_alone_is_no_ground_to_follow_from(hill):
    first, shape = np.array([KEY_ZERO - 100, KEY_ZERO - 40]), (80, 200)
    heights = np.full(shape, NOWHERE, np.int32)
    heights[40, 100] = 0
    driven = DrivenGround(heights, np.zeros(shape, np.bool_), first)

    ground_m = ground_heights(hill, first=first, shape=shape, floor_z_m=0.0, driven=driven)

    expected_m = ground_heights(hill, first=first, shape=shape, floor_z_m=0.0)
    assert ground_m[40, 100] == 0.0
    np.testing.assert_array_equal(ground_m[:, 120:], expected_m[:, 120:])
