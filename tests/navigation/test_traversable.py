import numpy as np
import pytest

from mapper.core.errors import DataError, MapSizeError
from mapper.navigation.config import TraversableConfig
from mapper.navigation.reachable_floor import driven_ground, floor_of, margin_for, reachable_floor
from mapper.navigation.traversable_grid import traversable
from mapper.octree import sparse_grid
from mapper.octree.config import OctreeConfig, SliceConfig
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN
from mapper.octree.map import OctreeMap, read_octree
from mapper.octree.occupied_columns import occupied_columns
from mapper.octree.octomap_file import write_ot
from mapper.octree.slice import cut_slice

CELL = 0.05


def octree_of(*solids):
    """Make a map whose occupied voxels fill boxes of ((x, y, z) low, (x, y, z) high), metres."""
    octree = OctreeMap(OctreeConfig(resolution_m=CELL, max_range_m=1e3))
    for low, high in solids:
        axes = [np.arange(a + CELL / 2, b, CELL) for a, b in zip(low, high, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
        for point in points:  # each from inside its own voxel: nothing else is freed
            octree.insert_points(point[np.newaxis], point.astype(np.float64) + 1e-3)
    return octree


NO_PATH = np.empty((0, 3))


def traversable_grid(octree, config, *, path=NO_PATH, floor_z_m=0.0):
    """Return the grid of the only storey; without a path it begins at all floor at the floor's height."""
    columns = occupied_columns(octree, margin=margin_for(config, CELL))
    floor = floor_of(columns, config, paths_world=[np.asarray(path)], floor_z_m=floor_z_m)
    (storey,) = traversable(floor, config).storeys
    return storey.grid


def floor(x0=0.0, x1=2.0, *, z=0.0, y1=1.0):
    return (x0, 0.0, z - CELL), (x1, y1, z)


def code_at(grid, x, y):
    column, row = np.floor((np.array([x, y]) - grid.origin_world_m) / grid.resolution_m).astype(int)
    inside = 0 <= row < grid.cells.shape[0] and 0 <= column < grid.cells.shape[1]
    return grid.cells[row, column] if inside else UNKNOWN


def row_codes(grid, xs, y=0.5):
    return [int(code_at(grid, x, y)) for x in xs]


def test_a_bare_floor_is_free_and_the_grid_is_just_large_enough():
    grid = traversable_grid(octree_of(floor()), TraversableConfig())
    assert grid.cells.shape == (20, 40)
    assert (grid.cells == FREE).all()
    np.testing.assert_allclose(grid.origin_world_m, [0.0, 0.0], atol=1e-9)


def test_a_table_blocks_by_its_height_and_a_lamp_does_not():
    table = (0.5, 0.0, 0.7), (0.8, 1.0, 0.75)
    lamp = (1.2, 0.0, 1.5), (1.5, 1.0, 1.55)
    octree = octree_of(floor(), table, lamp)

    assert row_codes(traversable_grid(octree, TraversableConfig()), [0.2, 0.65, 1.35, 1.8]) == [
        FREE,
        OCCUPIED,
        FREE,
        FREE,
    ]
    low = TraversableConfig(head_room_m=0.5)
    assert row_codes(traversable_grid(octree, low), [0.2, 0.65, 1.35, 1.8]) == [FREE] * 4
    tall = TraversableConfig(head_room_m=1.6)
    assert row_codes(traversable_grid(octree, tall), [0.65, 1.35, 1.8]) == [OCCUPIED, OCCUPIED, FREE]


@pytest.mark.parametrize(("height_m", "code"), [(0.05, FREE), (0.1, FREE), (0.15, OCCUPIED)])
def test_steps_up_and_down_are_climbed_to_a_limit(height_m, code):
    up = octree_of(floor(0.0, 1.0), floor(1.0, 2.0, z=height_m))
    assert row_codes(traversable_grid(up, TraversableConfig()), [0.5, 1.5]) == [FREE, code]
    down = octree_of(floor(0.0, 1.0), floor(1.0, 2.0, z=-height_m))
    assert row_codes(traversable_grid(down, TraversableConfig()), [0.5, 1.5]) == [FREE, code]


def ramp(rise_per_cell, *, first_x=1.0, cells=20):
    """Make a floor followed by a ramp of columns, each ``rise_per_cell`` voxels higher on average."""
    solids = [floor(0.0, first_x)]
    for n in range(cells):
        z = CELL * int((n + 1) * rise_per_cell)
        solids.append(floor(first_x + n * CELL, first_x + (n + 1) * CELL, z=z))
    return octree_of(*solids)


def test_a_gentle_ramp_is_free_and_a_steep_one_is_not():
    gentle, steep = ramp(0.2), ramp(0.6)  # 11° and 31°
    assert row_codes(traversable_grid(gentle, TraversableConfig()), [0.5, 1.5, 1.9]) == [FREE] * 3
    assert row_codes(traversable_grid(steep, TraversableConfig()), [0.5, 1.5, 1.9]) == [
        FREE,
        OCCUPIED,
        OCCUPIED,
    ]
    assert row_codes(traversable_grid(steep, TraversableConfig(max_slope_rad=0.6)), [1.5]) == [FREE]


@pytest.mark.parametrize("degrees", [30, 90, 135, 240])
def test_a_slope_is_measured_in_its_own_direction_up_to_the_edges(degrees):
    up = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(30), np.arange(30)))
    for slope, is_free in ((0.3, True), (0.42, False)):  # 17 and 23 degrees; the limit is 20
        tops = np.floor((np.column_stack([x, y]) - 15.0) @ up * slope)
        columns = zip(x * CELL, y * CELL, tops * CELL, strict=True)
        solids = [((x0, y0, z - CELL), (x0 + CELL, y0 + CELL, z)) for x0, y0, z in columns]
        grid = traversable_grid(octree_of(*solids), TraversableConfig())
        assert ((grid.cells == FREE) == is_free).all()


def test_what_only_a_steep_side_leads_to_is_no_floor():
    solids = [floor(0.0, 1.0)]
    solids += [((1.0 + n * CELL, 0.0, 0.0), (1.05 + n * CELL, 1.0, (n + 1) * 2 * CELL)) for n in range(10)]
    solids.append(((1.5, 0.0, 0.9), (3.0, 1.0, 1.0)))  # a platform that a 63° bank leads to
    grid = traversable_grid(octree_of(*solids), TraversableConfig())
    assert row_codes(grid, [0.3, 1.25, 2.8]) == [FREE, OCCUPIED, OCCUPIED]


def test_small_gaps_are_closed_and_large_ones_stay_unknown():
    octree = octree_of(floor(0.0, 1.0), floor(1.1, 2.0), floor(2.4, 3.0))
    grid = traversable_grid(octree, TraversableConfig())
    assert row_codes(grid, [1.025, 1.075]) == [FREE, FREE]
    assert row_codes(grid, [2.1, 2.2, 2.3]) == [UNKNOWN] * 3
    assert (
        row_codes(traversable_grid(octree, TraversableConfig(max_gap_m=0.0)), [1.025, 1.075]) == [UNKNOWN] * 2
    )


@pytest.mark.parametrize("gap_m", [0.0, 0.05, 0.1, 0.15, 0.25])
def test_closing_gaps_moves_no_floor(gap_m):
    grid = traversable_grid(octree_of(floor(0.0, 1.0)), TraversableConfig(max_gap_m=gap_m))
    assert grid.cells.shape == (20, 20)
    np.testing.assert_allclose(grid.origin_world_m, [0.0, 0.0], atol=1e-9)
    assert (grid.cells == FREE).all()


def test_the_robot_s_radius_widens_what_blocks():
    octree = octree_of(floor(), ((1.0, 0.0, 0.0), (1.05, 1.0, 0.5)))
    grid = traversable_grid(octree, TraversableConfig(robot_radius_m=0.2))
    assert row_codes(grid, [0.775, 0.825, 0.975, 1.225, 1.275]) == [FREE, OCCUPIED, OCCUPIED, OCCUPIED, FREE]


def test_the_floor_may_lie_anywhere():
    octree = octree_of(floor(z=-1.0), ((0.5, 0.0, -0.5), (0.8, 1.0, -0.45)))
    assert row_codes(traversable_grid(octree, TraversableConfig(), floor_z_m=-1.0), [0.2, 0.6]) == [
        FREE,
        OCCUPIED,
    ]
    assert (traversable_grid(octree, TraversableConfig()).cells == UNKNOWN).all()


def test_the_grid_does_not_depend_on_the_order_of_the_blocks(tmp_path):
    octree = octree_of(floor(), ((0.5, 0.0, 0.0), (0.8, 0.4, 0.3)), ((1.5, 0.5, 0.3), (1.6, 1.0, 0.4)))
    write_ot(tmp_path / "map.ot", octree)
    ours, theirs = (
        traversable_grid(octree, TraversableConfig()),
        traversable_grid(read_octree(tmp_path / "map.ot"), TraversableConfig()),
    )
    np.testing.assert_array_equal(ours.cells, theirs.cells)
    np.testing.assert_array_equal(ours.origin_world_m, theirs.origin_world_m)


def test_an_empty_map_has_no_floor():
    with pytest.raises(DataError, match="the map is empty"):
        reachable_floor(OctreeMap(OctreeConfig()), TraversableConfig(), positions_world=NO_PATH)


def test_a_path_without_a_width_begins_at_the_ground_below_it():
    world = octree_of(floor(x1=4.0, z=1.0))
    path = [(x, 0.5, 1.3) for x in np.arange(0.2, 3.8, 0.1)]
    grid = traversable_grid(world, TraversableConfig(footprint_m=0.0), path=path)
    assert code_at(grid, 1.5, 0.2) == FREE


def test_a_path_may_begin_outside_the_map():
    """Frames without points are part of the path."""
    path = [(x, 0.5, 0.3) for x in np.arange(9.0, 0.5, -0.3)]
    assert code_at(traversable_grid(octree_of(floor()), TraversableConfig(), path=path), 1.5, 0.5) == FREE


def test_the_footprint_is_free_beside_the_map_too():
    """A sensor that looks forward begins where the map does."""
    octree = octree_of(floor(x1=4.0))
    path = [(x, 0.5, 0.3) for x in np.arange(0.02, 3.0, 0.1)]
    reached = reachable_floor(octree, TraversableConfig(footprint_m=0.3), positions_world=np.array(path))
    (storey,) = traversable(reached, TraversableConfig()).storeys
    level = cut_slice(octree, SliceConfig(), driven=driven_ground(reached))
    for grid in (storey.grid, level):
        assert code_at(grid, -0.2, 0.5) == FREE
        assert code_at(grid, -0.35, 0.5) == UNKNOWN


def test_a_floor_too_wide_for_memory_is_refused_before_it_is_made(monkeypatch):
    octree = OctreeMap(OctreeConfig(resolution_m=0.05))
    for corner_m in (-1200.0, 1200.0):
        octree.insert_points(np.full((1, 3), corner_m, np.float32), np.full(3, corner_m))
    monkeypatch.setattr(
        sparse_grid.os, "sysconf", lambda name: {"SC_PAGE_SIZE": 1, "SC_PHYS_PAGES": 2**35}[name]
    )
    wanted = (
        r"a floor of 240\d × 240\d m in cells of 0\.05 m needs 10\d\.\d GiB and this machine has 32\.0; raise"
    )
    with pytest.raises(MapSizeError, match=wanted):
        reachable_floor(octree, TraversableConfig(), positions_world=NO_PATH)


def test_one_storey_is_left_where_all_are_small():
    rng = np.random.default_rng(0)
    config = TraversableConfig(max_step_m=0.3, max_slope_rad=1.4, max_gap_m=0.3, head_room_m=0.1)
    for _ in range(30):
        octree = OctreeMap(OctreeConfig(resolution_m=0.05))
        octree.insert_points(rng.uniform(-0.4, 0.4, (300, 3)).astype(np.float32), np.zeros(3))
        storeys = traversable(reachable_floor(octree, config, positions_world=NO_PATH), config).storeys
        assert len(storeys) == 1
