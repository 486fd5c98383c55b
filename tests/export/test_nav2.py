import json

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.export.exporters import export
from mapper.export.nav2 import (
    FREE_SPACE,
    INSCRIBED,
    LETHAL,
    NO_INFORMATION,
    inflate,
    keepout_mask,
    slowed_percent,
)
from mapper.navigation.config import CostmapConfig
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, read_grid


def grid_of(text, *, origin=(0.0, 0.0)):
    """Return a grid of 0.1 m drawn by characters, the top row first: . free, # occupied, ? unknown."""
    values = {".": FREE, "#": OCCUPIED, "?": UNKNOWN}
    rows = [[values[character] for character in line] for line in text.split()][::-1]
    return OccupancyGrid(np.array(rows, np.int8), np.array(origin), 0.1)


def test_what_the_slice_calls_free_and_the_floor_blocked_is_kept_out_of():
    grid = grid_of(".....  .#...  ??...")
    floor = grid_of("..#  .#.  ...", origin=(0.1, 0.0))
    mask = keepout_mask(grid, floor)
    np.testing.assert_array_equal(mask.cells == OCCUPIED, grid_of("...#.  ..#..  .....").cells == OCCUPIED)
    assert not (mask.cells == UNKNOWN).any()


def test_a_floor_larger_than_the_slice_is_cut():
    mask = keepout_mask(grid_of("..  .."), grid_of("####  ####  ####", origin=(-0.1, -0.1)))
    assert (mask.cells == OCCUPIED).all()


def test_a_robot_is_slowed_near_obstacles_alone():
    grid = grid_of("#" + 20 * ".")
    free = OccupancyGrid(np.zeros_like(grid.cells), grid.origin_world_m, 0.1)
    slowed = slowed_percent(grid, free, CostmapConfig(robot_radius_m=0.3, inflation_radius_m=0.8))[0]
    assert slowed[0] == slowed[3] == 70
    assert (np.diff(slowed.astype(int)) <= 0).all()
    assert slowed[7] > 0
    assert not slowed[8:].any()


def test_the_folder_holds_what_nav2_loads(desk_run, tmp_path):
    yaml = pytest.importorskip("yaml")
    out = export(desk_run, "nav2", tmp_path / "nav2")
    written = {path.name for path in out.iterdir()}
    launch = yaml.safe_load((out / "map.launch.yaml").read_text())["launch"]
    nodes = {entry["node"]["name"]: entry["node"] for entry in launch}
    (managed,) = [
        p["value"] for p in nodes.pop("lifecycle_manager_map")["param"] if p["name"] == "node_names"
    ]
    assert managed == list(nodes)
    parameters = yaml.safe_load((out / "nav2_params.yaml").read_text())
    for name, node in nodes.items():
        assert name in parameters
        files = [entry.get("from") or entry["value"] for entry in node["param"]]
        assert {file.removeprefix("$(dirname)/") for file in files} <= written
    masks = {
        parameters[name]["ros__parameters"]["topic_name"] for name in nodes if name.endswith("mask_server")
    }
    used = {parameters[n]["ros__parameters"]["mask_topic"] for n in nodes if n.endswith("info_server")}
    assert masks == used
    own = read_grid(desk_run.path / "slice.yaml")
    for stem in ("map", "keepout_mask"):
        assert read_grid(out / f"{stem}.yaml").cells.shape == own.cells.shape
    assert "mode: raw" in (out / "speed_mask.yaml").read_text()
    assert json.loads((out / "manifest.json").read_text())["run"] == str(desk_run.path.resolve())


def cells_of(cells):
    return OccupancyGrid(np.array(cells, np.int8), np.array([0.0, 0.0]), 0.05)


def nav2_cost(cells, *, radius_m, scaling):
    """nav2_costmap_2d's InflationLayer::computeCost, word for word."""
    if cells == 0:
        return LETHAL
    if cells * 0.05 <= radius_m:
        return INSCRIBED
    return int((INSCRIBED - 1) * np.exp(-scaling * (cells * 0.05 - radius_m)))


def test_costs_fall_as_nav2_s_do():
    cells = np.full((1, 30), FREE)
    cells[0, 0] = OCCUPIED

    got = inflate(cells_of(cells), robot_radius_m=0.2, inflation_radius_m=0.55, cost_scaling=3.0)

    expected = [nav2_cost(n, radius_m=0.2, scaling=3.0) for n in range(30)]
    reach = int(np.ceil(0.55 / 0.05))
    assert got[0, : reach + 1].tolist() == expected[: reach + 1]
    assert (got[0, reach + 1 :] == FREE_SPACE).all()
    assert got[0, 4] == INSCRIBED  # 0.2 m is on the radius, whatever 4 · 0.05 rounds to
    assert got.dtype == np.uint8


def test_costs_depend_on_the_straight_distance():
    cells = np.full((11, 11), FREE)
    cells[5, 5] = OCCUPIED
    got = inflate(cells_of(cells), robot_radius_m=0.0, inflation_radius_m=1.0, cost_scaling=5.0)
    assert got[8, 9] == got[5, 10] == nav2_cost(5.0, radius_m=0.0, scaling=5.0)  # 3-4-5
    np.testing.assert_array_equal(got, got.T)


def test_unknown_stays_unknown_unless_the_robot_would_touch():
    cells = np.full((1, 10), UNKNOWN)
    cells[0, 0] = OCCUPIED
    got = inflate(cells_of(cells), robot_radius_m=0.1, inflation_radius_m=0.5, cost_scaling=1.0)[0]
    assert got.tolist() == [LETHAL, INSCRIBED, INSCRIBED] + [NO_INFORMATION] * 7


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ((-0.1, 0.5, 1.0), "robot radius -0.1"),
        ((0.1, 0.05, 1.0), "inflation radius 0.05 m, want at least the robot's 0.1 m"),
        ((0.1, np.inf, 1.0), "inflation radius inf"),
        ((0.1, 0.5, np.nan), "cost scaling nan"),
    ],
)
def test_impossible_settings_are_refused(settings, complaint):
    radius_m, inflation_m, scaling = settings
    with pytest.raises(DataError, match=complaint):
        inflate(
            cells_of([[FREE]]), robot_radius_m=radius_m, inflation_radius_m=inflation_m, cost_scaling=scaling
        )
