import json

import numpy as np
import pytest

from mapper.core.errors import ConfigError, RunError
from mapper.export.exporters import export
from mapper.export.nav2 import keepout_mask, slowed_percent
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


def test_a_folder_is_named_and_spared_unless_told(desk_run, tmp_path):
    with pytest.raises(ConfigError, match="name it with --out"):
        export(desk_run, "nav2")
    export(desk_run, "nav2", tmp_path / "nav2")
    with pytest.raises(RunError, match="exists already"):
        export(desk_run, "nav2", tmp_path / "nav2")
    export(desk_run, "nav2", tmp_path / "nav2", overwrite=True)
    (tmp_path / "nav2" / "notes.txt").write_text("mine")
    with pytest.raises(RunError, match=r"notes\.txt"):
        export(desk_run, "nav2", tmp_path / "nav2", overwrite=True)
