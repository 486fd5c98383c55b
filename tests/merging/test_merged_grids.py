"""Slice, floor and plans of merged maps: those of the same map in memory, below the paths of all runs."""

import json
from dataclasses import replace

import numpy as np
import pytest

from mapper.cli.main import app
from mapper.core.errors import RunError
from mapper.core.geometry import apply, exp
from mapper.mapping.config import AppliedEdit, Region
from mapper.merging.slicing import floor_of_map
from mapper.merging.world_poses import Placed, as_built
from mapper.navigation.config import TraversableConfig
from mapper.navigation.reachable_floor import driven_ground, floor_of, margin_for
from mapper.navigation.traversable_grid import traversable
from mapper.octree.config import SliceConfig
from mapper.octree.grid import FREE, OCCUPIED, read_grid
from mapper.octree.map import OctreeMap, read_octree
from mapper.octree.occupied_columns import occupied_columns
from mapper.octree.slice import cut_slice
from tests.support.command_line import mapper
from tests.support.floor_scenes import two_storeys
from tests.support.grids import state_at
from tests.support.merged_runs import BAND, ROBOT, make_run, merged_map_of
from tests.support.octree_maps import COLORED, CONFIG, as_dict, mapped, total


@pytest.fixture(autouse=True)
def undrawn(monkeypatch):
    """Spare the picture, which takes half a second."""
    monkeypatch.setattr("mapper.merging.merge.draw", lambda *_: None)


@pytest.fixture(scope="module")
def maps():
    return [mapped(seed, config=COLORED) for seed in range(3)]


@pytest.mark.parametrize("above", ["floor", "ground"])
def test_the_slice_is_that_of_the_whole(maps, tmp_path, above):
    band = BAND.model_copy(update={"above": above, "min_cluster_cells": 2})
    runs = [make_run(tmp_path / f"run{i}", each, band=band) for i, each in enumerate(maps[:3])]

    found = merged_map_of(as_built(runs), tmp_path / "map").map

    octree, _ = total(maps[:3], config=COLORED)
    driven = driven_ground(floor_of_whole(octree, runs))
    assert driven.swept.any()
    grid, expected = found.slice, cut_slice(octree, band, driven=driven)
    np.testing.assert_array_equal(grid.cells, expected.cells)
    np.testing.assert_allclose(grid.origin_world_m, expected.origin_world_m)
    columns = {(x, y) for x, y, _ in as_dict(octree)}
    assert found.manifest.area_km2 == pytest.approx(len(columns) * 0.1**2 / 1e6, rel=1e-6)


def floor_of_whole(octree, runs):
    """Return the floor of a map in memory below the paths of all runs."""
    columns = occupied_columns(octree, margin=margin_for(ROBOT, octree.resolution_m))
    return floor_of(columns, ROBOT, paths_world=[run.trajectory.positions_world for run in runs])


def test_the_floor_is_that_of_the_whole_below_all_paths(maps, tmp_path):
    runs = [make_run(tmp_path / f"run{i}", each) for i, each in enumerate(maps[:3])]
    octree, _ = total(maps[:3], config=COLORED)
    expected = traversable(floor_of_whole(octree, runs), ROBOT)

    found = merged_map_of(as_built(runs), tmp_path / "map", tile_m=2.4).map

    home = expected.home
    assert (home.grid.cells == FREE).any()
    np.testing.assert_array_equal(found.traversable.cells, home.grid.cells)
    np.testing.assert_allclose(found.traversable.origin_world_m, home.grid.origin_world_m)
    for one, other in zip(floor_of_map(found).storeys, expected.storeys, strict=True):
        np.testing.assert_array_equal(one.heights, other.heights)
    assert (found.path / "traversable_0.pgm").exists() == (len(expected.storeys) > 1)


def test_a_map_too_wide_for_a_floor_says_so(maps, tmp_path, monkeypatch):
    monkeypatch.setattr("mapper.merging.slicing.MOST_COLUMNS", 100)

    found = merged_map_of(as_built([make_run(tmp_path / "run", maps[0])]), tmp_path / "map").map

    assert any("no traversable floor: the map's bounding box has" in note for note in found.manifest.notes)
    assert (found.slice.cells == FREE).any()
    with pytest.raises(RunError, match=r"has no traversable\.yaml; no traversable floor: the map's bounding"):
        _ = found.traversable


def test_a_path_is_planned_on_a_merged_map(tmp_path, capsys):
    octree = OctreeMap(CONFIG)
    sides = np.linspace(-1.95, 1.95, 40).astype(np.float32)
    ring = [(x, y, 0.05) for x in sides for y in sides if max(abs(x), abs(y)) > 1.9]
    octree.insert_points(np.array(ring, np.float32), np.array([0.05, 0.05, 0.05]))
    merged_map_of(as_built([make_run(tmp_path / "run", octree)]), tmp_path / "map")

    app(
        ["plan", str(tmp_path / "map"), "--from", "-1", "0", "--to", "1", "0.5", "--radius", "0.1"],
        standalone_mode=False,
    )

    assert capsys.readouterr().out.startswith("2.06 m in the slice")
    assert (tmp_path / "map/plan.png").stat().st_size > 10_000
    assert '"map": "slice"' in (tmp_path / "map/plan.json").read_text()


def test_a_merged_map_is_driven_on(tmp_path):
    """Two runs, each of which saw one storey's part of the way: together they lead up the stairs."""
    world, robot = two_storeys(), TraversableConfig(max_step_m=0.2, head_room_m=1.8, max_gap_m=0.2)
    path, octree = world.positions(), world.octree(0.1)
    half = len(path) // 2
    runs = [
        make_run(tmp_path / name, octree, positions=part, log=name, traversable=robot)
        for name, part in (("down", path[: half + 1]), ("up", path[half:]))
    ]

    found = merged_map_of(as_built(runs), tmp_path / "map", tile_m=6.4).map

    assert (found.path / "traversable_1.yaml").exists()
    answer = mapper(
        *("plan", found.path, "--from", "8 6", "--to", "2 5 3.06", "--radius", "0.15"),
        *("--layer", "traversable", "--json"),
    )
    waypoints = np.array(json.loads(answer.stdout)["waypoints_world_m"])
    np.testing.assert_allclose(waypoints[[0, -1]], [[8.0, 6.0, 0.0], [2.0, 5.0, 3.1]], atol=0.11)

    mapper("export", found.path, "--as", "nav2", "--out", tmp_path / "nav2")
    mapper("export", found.path, "--as", "gis", "--out", tmp_path / "gis")
    layers = {path.name for path in (tmp_path / "gis").glob("*.p[gn][wg]")}
    assert layers >= {"slice.png", "slice.pgw", "traversable.png", "traversable.pgw"}
    loaded = read_grid(tmp_path / "nav2" / "map.yaml")
    np.testing.assert_array_equal(loaded.cells, found.slice.cells)
    mapper("export", found.path, "--as", "costmap", "--set", "costmap.robot_radius_m=0.3")
    assert (found.path / "costmap.yaml").exists()
    mapper("export", found.path, "--as", "octomap", "--level", 1, "--out", tmp_path / "coarse.bt")
    assert read_octree(tmp_path / "coarse.bt").resolution_m == pytest.approx(0.2)
    refused = mapper("export", found.path, "--as", "mesh", status=1)
    assert "a merged map has no mesh, only octomap, grid, costmap, nav2" in refused.stderr


def test_keepout_regions_of_a_run_that_is_turned_hold_on_their_storeys(tmp_path):
    world, robot = two_storeys(), TraversableConfig(max_step_m=0.2, head_room_m=1.8, max_gap_m=0.2)
    run = make_run(
        tmp_path / "house",
        world.octree(0.1),
        band=SliceConfig(),
        positions=world.positions(),
        traversable=robot,
    )
    polygon = ((4.0, 4.0), (6.0, 4.0), (6.0, 6.0), (4.0, 6.0))
    above, below = (
        Region(box_m=((4.0, 2.0, 3.0), (6.0, 7.0, 4.0))),
        Region(polygon_m=polygon, height_m=(-1, 1)),
    )
    edits = tuple(AppliedEdit(kind="keepout", region=region, count=1) for region in (above, below))
    edited = replace(run, manifest=run.manifest.model_copy(update={"edits": edits}))
    T_map_world = exp(np.array([0.0, 0.0, np.pi / 2]), np.array([3.0, -2.0, 0.0]))

    plain = merged_map_of([Placed(run, T_map_world, "by hand")], tmp_path / "plain").map
    found = merged_map_of([Placed(edited, T_map_world, "by hand")], tmp_path / "map").map

    def cells(folder, stem, x, y):
        grid = read_grid(folder.path / f"{stem}.yaml")
        (point,) = apply(T_map_world, np.array([[x, y, 0.0]]))
        return state_at(grid, *point[:2])

    assert cells(found, "traversable_0", 5.0, 5.0) == cells(found, "traversable_1", 5.0, 3.0) == OCCUPIED
    assert cells(found, "traversable_0", 5.0, 3.0) == cells(found, "traversable_1", 7.0, 5.0) == FREE
    assert cells(plain, "traversable_0", 5.0, 5.0) == cells(plain, "traversable_1", 5.0, 3.0) == FREE
    assert cells(found, "keepout", 5.0, 5.0) == OCCUPIED != cells(found, "keepout", 5.0, 3.0)
    np.testing.assert_array_equal(found.slice.cells, plain.slice.cells)
    assert plain.keepout is None

    (x, y, _), (x_free, y_free, _) = apply(T_map_world, np.array([[5.0, 5.0, 0.0], [8.0, 6.0, 0.0]]))
    for layer in ("slice", "traversable"):
        ends = "--from", f"{x_free} {y_free}", "--to", f"{x} {y}", "--radius", "0.15", "--layer", layer
        mapper("plan", plain.path, *ends)
        assert "goal" in mapper("plan", found.path, *ends, status=1).stderr
    ends = "--3d", "--from", f"{x_free} {y_free} 0.5", "--to", f"{x} {y} 0.5", "--unknown", "free"
    mapper("plan", plain.path, *ends, "--radius", "0.15")
    assert "goal" in mapper("plan", found.path, *ends, "--radius", "0.15", status=1).stderr
    mapper("export", found.path, "--as", "nav2", "--out", tmp_path / "nav2")
    mask, kept_out = read_grid(tmp_path / "nav2/keepout_mask.yaml").cells, found.keepout.cells == OCCUPIED
    assert (mask[kept_out & (found.slice.cells != OCCUPIED)] == OCCUPIED).all()
