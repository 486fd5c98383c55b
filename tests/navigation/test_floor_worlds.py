"""The traversable floor and the slice against the exact geometry of small worlds."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.navigation.config import TraversableConfig
from mapper.navigation.reachable_floor import driven_ground, reachable_floor
from mapper.navigation.traversable_grid import traversable
from mapper.octree.config import SliceConfig
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN
from mapper.octree.slice import cut_slice
from tests.support.floor_scenes import WORLDS, bridge, courtyard, ramps, retaining_wall, rooms, two_storeys
from tests.support.floor_worlds import SENSOR_M, Slab, World, score

WAYS_UP = {
    "two_storeys": [(x, 0.65) for x in np.arange(1.0, 6.4, 0.1)],
    "bridge": [(x, 11.5) for x in np.arange(4.5, 16.0, 0.1)],
    "ramps": [(x, 9.5) for x in np.arange(4.5, 16.0, 0.1)],
}
BAND = SliceConfig(min_height_m=0.3, max_height_m=1.8, above="ground")


def config_for(cell_m, **settings):
    window_m = max(0.6, 5 * cell_m)
    return TraversableConfig(
        **{"max_step_m": 0.2, "head_room_m": 1.8, "slope_window_m": window_m, "max_gap_m": 2 * cell_m}
        | settings
    )


def floor_of(world, cell_m, *, seed=None, **settings):
    config = config_for(cell_m, **settings)
    octree = world.octree(cell_m, seed=seed)
    return octree, reachable_floor(octree, config, positions_world=world.positions()), config


def codes_at(grid, points):
    columns, rows = (
        np.floor((np.asarray(points)[:, :2] - grid.origin_world_m) / grid.resolution_m).astype(int).T
    )
    inside = (rows >= 0) & (rows < grid.cells.shape[0]) & (columns >= 0) & (columns < grid.cells.shape[1])
    codes = np.full(len(rows), UNKNOWN)
    codes[inside] = grid.cells[rows[inside], columns[inside]]
    return codes


@pytest.mark.parametrize("name", WORLDS)
def test_the_floor_is_where_a_robot_can_drive(name):
    world, config = WORLDS[name](), config_for(0.1)
    truth = world.reachable(
        step_m=config.max_step_m, slope=np.tan(config.max_slope_rad), room_m=config.head_room_m
    )
    for cell_m, seed in ((0.1, 1), (0.2, None)):  # noisy, and exact
        found = score(world, truth, world.octree(cell_m, seed=seed), config_for(cell_m))
        assert found.precision >= 0.995
        assert found.recall >= 0.98
        assert (found.path_blocked, found.path_unknown) == (0.0, 0.0)


@pytest.mark.parametrize("name", sorted(set(WORLDS) - {"bridge", "two_storeys"}))
@pytest.mark.parametrize("cell_m", [0.1, 0.2])
def test_the_path_is_free_in_a_slice_that_follows_the_ground(name, cell_m):
    world = WORLDS[name]()
    octree, floor, _ = floor_of(world, cell_m)
    grid = cut_slice(octree, BAND, driven=driven_ground(floor))
    assert (codes_at(grid, world.positions()) == FREE).all()


@pytest.mark.parametrize("drop_m", [0.5, 0.8, 2.0])
def test_a_lower_yard_behind_a_wall_does_not_move_the_ground_of_the_street(drop_m):
    world = retaining_wall()
    yard = Slab(0.0, 24.0, 6.3, 14.0, -drop_m)
    world.slabs[1] = yard
    octree, floor, _ = floor_of(world, 0.2)
    street = [(x, y) for x in np.arange(1.0, 23.0, 0.5) for y in np.arange(0.5, 5.6, 0.5)]
    grid = cut_slice(octree, BAND, driven=driven_ground(floor))
    assert (codes_at(grid, street) != OCCUPIED).all()
    assert (codes_at(grid, [(x, 6.1) for x in np.arange(1.0, 23.0)]) == OCCUPIED).all()
    (storey,) = traversable(floor, config_for(0.2)).storeys
    assert (codes_at(storey.grid, street) == FREE).all()
    assert (codes_at(storey.grid, [(x, 10.0) for x in np.arange(1.0, 23.0)]) != FREE).all()


def test_floors_over_each_other_are_storeys_that_share_the_ramps_between_them():
    for world_of, heights_m in ((two_storeys, [0.0, 3.06]), (bridge, [0.0, 3.0]), (ramps, [0.0, 2.5])):
        world = world_of()
        _, floor, config = floor_of(world, 0.1)
        found = traversable(floor, config)
        storeys = found.storeys
        usual = [np.median(s.heights[s.heights > -1000]) * 0.1 for s in storeys]
        np.testing.assert_allclose(usual, heights_m, atol=0.11)
        assert len(storeys) == 2
        assert found.home is storeys[0]
        upper = [point for point in world.path if point[2] > 2.4]
        assert codes_at(storeys[0].grid, world.path[:1]).tolist() == [FREE]
        assert (codes_at(storeys[1].grid, upper) == FREE).all()
        shared = [
            xy for xy in WAYS_UP[world_of.__name__] if all(codes_at(s.grid, [xy]) == FREE for s in storeys)
        ]
        assert shared


def test_home_is_the_storey_on_which_the_path_begins_wherever_the_world_lies():
    world = two_storeys()
    slabs, blocks = (
        [replace(solid, x0=solid.x0 + 40.0, x1=solid.x1 + 40.0) for solid in solids]
        for solids in (world.slabs, world.blocks)
    )
    down = [(x + 40.0, y, z) for x, y, z in world.path[::-1]]
    _, floor, config = floor_of(World(slabs, blocks, down), 0.1)
    found = traversable(floor, config)
    assert len(found.storeys) == 2
    assert found.home is found.storeys[1]


def test_a_room_without_a_door_is_no_floor():
    _, floor, config = floor_of(rooms(), 0.1)
    (storey,) = traversable(floor, config).storeys
    assert (codes_at(storey.grid, [(10.5, 3.0), (11.0, 1.0)]) == UNKNOWN).all()


def test_bushes_do_not_lead_up_to_canopies():
    _, floor, config = floor_of(courtyard(), 0.2)
    (storey,) = traversable(floor, config).storeys
    assert codes_at(storey.grid, [(8.0, 3.0), (11.0, 4.0)]).tolist() == [OCCUPIED, OCCUPIED]
    assert storey.heights.max() <= 2  # canopies hang 11 voxels high and more


def test_a_step_below_a_voxel_counts_as_one_voxel():
    world = rooms()
    (coarse,) = traversable(*floor_of(world, 0.2, max_step_m=0.05)[1:]).storeys
    assert (codes_at(coarse.grid, world.positions()) == FREE).all()


def test_ground_that_was_never_seen_is_free_under_the_footprint_alone():
    world = World([Slab(0.0, 10.0, 0.0, 4.0)], [], [(1.0, 2.0, 0.0), (9.0, 2.0, 0.0)], [(3.0, 7.0, 0.0, 4.0)])
    _, floor, config = floor_of(world, 0.1)
    (storey,) = traversable(floor, config).storeys
    assert (codes_at(storey.grid, world.positions()) == FREE).all()
    assert codes_at(storey.grid, [(5.0, 2.3), (5.0, 2.7), (5.0, 0.5)]).tolist() == [FREE, UNKNOWN, UNKNOWN]
    np.testing.assert_allclose(floor.path.sensor_m, SENSOR_M, atol=0.101)


def test_a_camera_over_a_desk_does_not_make_the_desk_a_floor():
    """The path stays within half a metre over a table; floor is seen beside it."""
    table = Slab(1.0, 2.6, 1.0, 2.0, 0.7)
    world = World([Slab(0.0, 4.0, 0.0, 3.0), table], [], [(1.5, 1.4, 0.7), (2.0, 1.6, 0.7)], [(1, 2.6, 1, 2)])
    world.unseen = []
    octree = world.octree(0.05)
    config = TraversableConfig()
    floor = reachable_floor(octree, config, positions_world=world.positions() - np.array([0.0, 0.0, 0.6]))
    (storey,) = traversable(floor, config).storeys
    assert len(floor.path) == 0
    assert codes_at(storey.grid, [(1.8, 1.5), (0.5, 0.5)]).tolist() == [OCCUPIED, FREE]


def test_a_table_that_a_walking_camera_is_held_over_does_not_raise_the_path():
    table = Slab(4.0, 5.0, 1.4, 2.6, 0.75)
    world = World([Slab(0.0, 10.0, 0.0, 4.0), table], [], [(1.0, 2.0, 0.0), (9.0, 2.0, 0.0)])
    _, floor, config = floor_of(world, 0.1)
    np.testing.assert_allclose(floor.path.points_world[:, 2], 0.0, atol=0.101)
    (storey,) = traversable(floor, config).storeys
    assert codes_at(storey.grid, [(4.5, 2.0)]).tolist() == [OCCUPIED]
