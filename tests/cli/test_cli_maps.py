"""``mapper plan`` and ``mapper fuse --trajectory`` on a finished run, from the command line."""

import json
import shutil

import numpy as np
import pytest

from mapper.core.geometry import exp
from mapper.core.trajectory import Trajectory
from mapper.navigation.distance import distance_field, layer
from mapper.octree.grid import read_grid
from mapper.run.folder import open_run
from mapper.sources.trajectory_files import read_tum, write_tum
from tests.support.command_line import mapper


@pytest.fixture
def run_folder(desk_run, tmp_path):
    return shutil.copytree(desk_run.path, tmp_path / "desk")


def test_plan_leads_from_start_to_goal(run_folder):
    grid = read_grid(run_folder / "slice.yaml")
    clearance = distance_field(layer(grid), unknown_blocks=True).distances_m[0, 1:-1, 1:-1]
    row, column = np.unravel_index(np.argmax(clearance), clearance.shape)
    away = int((clearance[row, column] - 0.1) / grid.resolution_m)
    assert away >= 1, "the widest free place must hold a path"
    cells = np.array([[column, row], [column + away, row]])
    start, goal = np.asarray(grid.origin_world_m) + (cells + 0.5) * grid.resolution_m

    mapper("plan", run_folder, "--from", *start, "--to", *goal, "--radius", 0.05)

    plan = json.loads((run_folder / "plan.json").read_text())
    path = np.array(plan["waypoints_world_m"])
    assert np.allclose(path[[0, -1]], [start, goal], atol=1e-6)
    assert plan["length_m"] >= np.linalg.norm(goal - start) - 1e-9
    assert (run_folder / "plan.png").stat().st_size > 0


def test_fuse_takes_another_trajectory_and_casts_only_what_moved(run_folder, tmp_path):
    old = open_run(run_folder).trajectory
    poses = old.T_world_body.copy()
    poses[-3:] = exp(np.zeros(3), np.array([0.0, 0.0, 0.2])) @ poses[-3:]
    write_tum(tmp_path / "moved.tum", Trajectory(old.stamps_ns, poses))

    result = mapper("fuse", run_folder, "--trajectory", tmp_path / "moved.tum")

    assert f"3 of {len(old)} frames" in result.stdout + result.stderr
    assert np.allclose(read_tum(run_folder / "trajectory.tum").T_world_body, poses, atol=1e-12)
