"""A slice that follows the ground shows walls on a slope, and not the slope."""

import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.octree.columns import NOWHERE, DrivenGround, ground_heights
from mapper.octree.config import OctreeConfig, SliceConfig
from mapper.octree.grid import FREE, OCCUPIED
from mapper.octree.keys import KEY_ZERO
from mapper.octree.map import OctreeMap
from mapper.octree.slice import cut_slice
from tests.support.grids import state_at

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
