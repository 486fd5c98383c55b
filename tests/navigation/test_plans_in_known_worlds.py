"""Every navigation product against the exact geometry of a synthetic flat."""

from itertools import pairwise

import numpy as np
import pytest

from mapper.export.grid import write_grid
from mapper.navigation.config import PlanConfig, TraversableConfig
from mapper.navigation.distance import dense_voxels, distance_field
from mapper.navigation.planner import plan_2d, plan_3d
from mapper.navigation.reachable_floor import reachable_floor
from mapper.navigation.traversable_grid import traversable
from mapper.octree.config import OctreeConfig, SliceConfig
from mapper.octree.grid import FREE, OCCUPIED, read_grid
from mapper.octree.map import OctreeMap
from mapper.octree.slice import cut_slice
from mapper.simulation import Boxes, CameraSimulator
from mapper.simulation.config import SynthConfig
from tests.support.ideal_sensors import IDEAL_SENSOR

CELL = 0.05
BAND = SliceConfig(min_height_m=0.1, max_height_m=1.2)
RADIUS_M = 0.2
CONFIG = SynthConfig(
    width_px=160,
    height_px=120,
    texture_px_per_m=8,
    posters_per_room=0,
    furniture_per_room=5,
    frame_rate_hz=2.0,
    sensor=IDEAL_SENSOR,
)


@pytest.fixture(scope="module")
def source():
    return CameraSimulator(CONFIG)


@pytest.fixture(scope="module")
def octree(source):
    """Fuse a walk through all rooms at its true poses."""
    octree = OctreeMap(OctreeConfig(resolution_m=CELL, max_range_m=5.0))
    for entry, T_world_camera in zip(source.log().entries(), source.truth.T_world_body, strict=True):
        octree.insert(entry.load(colour=False).scan(), T_world_camera)
    return octree


@pytest.fixture(scope="module")
def grid(octree, tmp_path_factory):
    """The slice, after a round through the files that nav2 would load."""
    folder = tmp_path_factory.mktemp("slice")
    write_grid(folder, "slice", cut_slice(octree, BAND))
    return read_grid(folder / "slice.yaml")


@pytest.fixture(scope="module")
def walk(source):
    """Return two positions of the walk in opposite rooms, x and y."""
    positions = source.truth.positions_world
    return positions[len(positions) // 6, :2], positions[len(positions) * 2 // 3, :2]


def column_clearance_m(source, xy, heights_m):
    """Return how near vertical lines at (N, 2) come to true solids other than floor and ceiling."""
    boxes = source.scene.boxes
    upright = [i for i, name in enumerate(boxes.names) if name not in ("floor", "ceiling")]
    upright = Boxes(
        tuple(boxes.names[i] for i in upright),
        boxes.centers_world[upright],
        boxes.half_sizes_m[upright],
        boxes.yaws_rad[upright],
    )
    points = np.concatenate([np.column_stack([xy, np.full(len(xy), z)]) for z in heights_m])
    return upright.signed_distance_m(points).reshape(len(heights_m), -1).min(axis=0)


def along(waypoints):
    shares = np.linspace(0.0, 1.0, 200)[:, np.newaxis]
    return np.vstack([a + shares * (b - a) for a, b in pairwise(waypoints)])


def centres(grid, code):
    rows, columns = np.nonzero(grid.cells == code)
    return grid.origin_world_m + (np.column_stack([columns, rows]) + 0.5) * grid.resolution_m


def test_the_slice_read_by_nav2_s_rules_is_the_true_floor_plan(source, grid):
    """Free cells hold no solid in the band, occupied ones do; one voxel is the map's own accuracy."""
    heights_m = np.arange(BAND.min_height_m + CELL / 2, BAND.max_height_m, CELL)
    free, occupied = centres(grid, FREE), centres(grid, OCCUPIED)
    assert len(free) > 3000
    assert len(occupied) > 500
    assert (column_clearance_m(source, free, heights_m) > -CELL).mean() > 0.99
    assert (column_clearance_m(source, occupied, heights_m) < CELL).mean() > 0.99


def test_a_planned_path_is_collision_free_in_the_true_flat(source, grid, walk):
    plan = plan_2d(grid, *walk, config=PlanConfig(radius_m=RADIUS_M))
    heights_m = np.arange(BAND.min_height_m + CELL / 2, BAND.max_height_m, CELL)
    assert column_clearance_m(source, along(plan.waypoints_world), heights_m).min() > RADIUS_M - CELL
    assert plan.length_m > np.linalg.norm(walk[1] - walk[0])


def test_a_path_in_space_is_collision_free_in_the_true_flat(source, octree, walk):
    start, goal = (np.append(xy, 1.3) for xy in walk)
    plan = plan_3d(octree, start, goal, config=PlanConfig(radius_m=RADIUS_M))
    assert source.scene.boxes.signed_distance_m(along(plan.waypoints_world)).min() > RADIUS_M - CELL


def test_distances_agree_with_the_true_solids(source, octree):
    """Where the nearest obstacle has been seen, the field is the true distance within a voxel and a half."""
    field = distance_field(dense_voxels(octree, bytes_per_voxel=1), unknown_blocks=False)
    points = source.truth.positions_world
    true_m = source.scene.boxes.signed_distance_m(points)
    assert (field.distance(points) > true_m - 1.5 * CELL).all()  # never an obstacle that is not there
    assert np.mean(np.abs(field.distance(points) - true_m) < 1.5 * CELL) > 0.8


def test_the_traversable_floor_is_free_in_the_true_flat(source, octree):
    config = TraversableConfig()
    floor = reachable_floor(octree, config, positions_world=source.truth.positions_world)
    (storey,) = traversable(floor, config).storeys
    floor = storey.grid
    heights_m = np.arange(config.max_step_m + CELL / 2, config.head_room_m, CELL)
    free = centres(floor, FREE)
    assert len(free) > 3000
    assert (column_clearance_m(source, free, heights_m) > -CELL).mean() > 0.99
    positions = source.truth.positions_world  # of one room: so few frames miss the floor of doorways
    ends = positions[len(positions) // 6, :2], positions[len(positions) // 4, :2]
    plan = plan_2d(floor, *ends, config=PlanConfig(radius_m=RADIUS_M))
    assert column_clearance_m(source, along(plan.waypoints_world), heights_m).min() > RADIUS_M - CELL
