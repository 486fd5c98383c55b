"""Edits by hand: which voxels and cells a region holds, and what is left of octree and grids."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.mapping.config import Edits, Region
from mapper.mapping.edits import MapEditor, covered
from mapper.navigation.config import TraversableConfig
from mapper.navigation.reachable_floor import driven_ground, reachable_floor
from mapper.navigation.traversable_grid import traversable
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN
from tests.support.floor_scenes import two_storeys
from tests.support.grids import state_at
from tests.support.octree_maps import as_dict, mapped

PATH = np.array([[-0.4, 0.1, 0.0], [0.0, 0.2, 0.1], [0.5, 0.9, 0.3]])
SHAPE = ((-0.93, -1.02), (1.21, -0.61), (0.31, 0.11), (0.72, 1.43), (-0.64, 0.87))
"""A polygon that is not convex."""
REGIONS = {
    "box": Region(box_m=((-0.51, -2.0, -0.33), (0.42, 0.77, 1.0))),
    "height": Region(height_m=(-0.21, 0.36)),
    "path": Region(path_radius_m=0.45),
    "polygon": Region(polygon_m=SHAPE),
    "all": Region(
        box_m=((-0.8, -0.9, -1.0), (0.9, 1.2, 0.8)), height_m=(-0.5, 2.0), path_radius_m=1.0, polygon_m=SHAPE
    ),
}


def editor(**regions):
    return MapEditor(Edits(**regions), PATH, room_m=1.2)


def in_polygon(point, corners):
    """Return whether the corners go round a point: their angles seen from it add up to a turn."""
    around = np.array(corners) - point
    angles = np.arctan2(around[:, 1], around[:, 0])
    steps = np.diff(np.append(angles, angles[0]))
    return abs(np.sum((steps + np.pi) % (2 * np.pi) - np.pi)) > np.pi


def holds(region, point):
    low, high = region.box_m or ((-9.0,) * 3, (9.0,) * 3)
    bottom, top = region.height_m or (-9.0, 9.0)
    return (
        all(low[axis] <= point[axis] <= high[axis] for axis in range(3))
        and bottom <= point[2] <= top
        and (
            region.path_radius_m is None
            or np.linalg.norm(PATH[:, :2] - point[:2], axis=1).min() <= region.path_radius_m
        )
        and (region.polygon_m is None or in_polygon(point[:2], region.polygon_m))
    )


@pytest.mark.parametrize("region", REGIONS.values(), ids=REGIONS)
def test_erased_voxels_are_those_whose_centres_meet_every_condition(region):
    octree, before = mapped(1), mapped(1).leaves()
    inside = np.array([holds(region, centre) for centre in before.centres_world])
    erased = inside & (before.log_odds >= octree.occupied_log_odds)

    (done,) = editor(erase=(region,)).erase(octree)

    assert done.count == erased.sum() > 3
    expected = np.where(erased, octree.sensor.lowest, before.log_odds)
    np.testing.assert_array_equal(octree.leaves().log_odds, expected)


def test_only_voxels_in_one_of_the_kept_regions_are_left():
    octree, before = mapped(2), mapped(2).leaves()
    some = REGIONS["box"], REGIONS["polygon"]
    inside = np.array([[holds(region, centre) for region in some] for centre in before.centres_world])

    done = editor(keep=some).crop(octree)
    octree.drop_unknown()

    assert [edit.count for edit in done] == inside.sum(axis=0).tolist()
    np.testing.assert_array_equal(octree.leaves().keys, before.keys[inside.any(axis=1)])
    assert 0 < len(octree) == inside.any(axis=1).sum() < len(before.keys)


def test_a_region_beside_the_map_holds_nothing():
    octree = mapped(2)
    high = Region(height_m=(50.0, 60.0), path_radius_m=1.0, polygon_m=SHAPE)
    aside = Region(box_m=((50.0, 50.0, -9.0), (60.0, 60.0, 9.0)))
    assert [edit.count for edit in editor(erase=(high, aside)).erase(octree)] == [0, 0]


def test_without_regions_nothing_changes():
    octree = mapped(2)
    assert editor().erase(octree) == editor().crop(octree) == []
    assert as_dict(octree) == as_dict(mapped(2))


def test_a_crop_that_leaves_nothing_is_refused():
    octree = mapped(2)
    with pytest.raises(DataError, match=r"no voxel in a region to keep \(keep height_m = \[50.0, 60.0\]: 0"):
        editor(keep=(Region(height_m=(50.0, 60.0)),)).crop(octree)
    assert as_dict(octree) == as_dict(mapped(2))


def test_a_region_around_the_path_is_round():
    points = np.array([[0.5, 1.35], [0.5, 1.36], [0.82, 1.22], [0.5, 0.9]])
    assert covered(Region(path_radius_m=0.455), points, PATH).tolist() == [True, False, True, True]


@pytest.fixture(scope="module")
def house():
    """A hall with stairs to a floor above it: the path, the floor and its storeys."""
    world = two_storeys()
    config = TraversableConfig(max_step_m=0.2, head_room_m=1.8, max_gap_m=0.2)
    floor = reachable_floor(world.octree(0.1), config, positions_world=world.positions())
    return world.positions(), floor, traversable(floor, config)


def edited(house, **regions):
    positions, _, floor = house
    found, done = MapEditor(Edits(**regions), positions, room_m=1.8).edit_floor(floor)
    return found.storeys, done


def test_a_keepout_is_blocked_on_the_storeys_whose_room_it_reaches(house):
    square = ((2.0, 4.0), (4.0, 4.0), (4.0, 6.0), (2.0, 6.0))
    before = house[2].storeys
    assert [state_at(storey.grid, 3.0, 5.0) for storey in before] == [FREE, FREE]

    (hall, upper), (done,) = edited(house, keepout=(Region(polygon_m=square, height_m=(0.0, 1.0)),))
    assert [state_at(storey.grid, 3.0, 5.0) for storey in (hall, upper)] == [OCCUPIED, FREE]
    assert state_at(hall.grid, 1.95, 5.0) == FREE
    assert done.count == np.count_nonzero(hall.grid.cells != before[0].grid.cells) == 400

    both, _ = edited(house, keepout=(Region(polygon_m=square),))
    assert [state_at(storey.grid, 3.0, 5.0) for storey in both] == [OCCUPIED, OCCUPIED]


def test_a_crop_leaves_the_floor_whose_room_it_reaches(house):
    storeys, _ = edited(house, keep=(Region(box_m=((2.0, 2.0, 3.5), (9.0, 9.0, 6.0))),))
    (upper,) = storeys
    assert upper.heights[upper.heights > -1000].min() == 31
    assert upper.grid.origin_world_m == pytest.approx([2.0, 2.0])
    assert upper.heights.shape == upper.grid.cells.shape

    positions, _, floor = house
    for home_number in (0, 1):  # the path begins on what is left
        begins = replace(floor, home_number=home_number)
        editor = MapEditor(Edits(keep=(Region(box_m=((2.0, 2.0, 3.5), (9.0, 9.0, 6.0))),)), positions, 1.8)
        assert editor.edit_floor(begins)[0].home_number == 0

    (nothing,), _ = edited(house, keep=(Region(box_m=((50.0, 50.0, 0.0), (60.0, 60.0, 1.0))),))
    assert (nothing.grid.cells == UNKNOWN).all()


def test_the_path_is_swept_in_the_kept_regions_alone(house):
    positions, floor, _ = house
    before = driven_ground(floor)
    region = Region(polygon_m=((5.0, -1.0), (20.0, -1.0), (20.0, 20.0), (5.0, 20.0)))
    after = MapEditor(Edits(keep=(region,)), positions, 1.8).crop_ground(before, floor.columns)
    left_m = (floor.columns.first[0] - 32768) * 0.1
    x_m = left_m + (np.nonzero(after.swept)[1] + 0.5) * 0.1
    assert x_m.min() == pytest.approx(5.05)
    np.testing.assert_array_equal(after.heights, before.heights)
    assert 0 < after.swept.sum() < before.swept.sum()
