"""Logs of 2D lasers become maps: planar poses, loops, a sharp layer, and floor where it is free."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.geometry import fit_rigid
from mapper.core.timebase import nearest
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.octree.grid import FREE, OCCUPIED, read_grid
from mapper.pipeline.build import build
from mapper.pipeline.known_map import load_known_map
from mapper.pipeline.localise import localise
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.sources import open_source
from mapper.sources.trajectory_files import read_tum
from tests.support.planar import at
from tests.support.planar_drives import (
    FIRST_NS,
    RPLIDAR,
    SICK,
    corridor,
    drive,
    flat,
    write_carmen,
    write_ros,
)


def truth_of(driven):
    stamps_ns = FIRST_NS + np.rint(1e9 * driven.times_s).astype(np.int64)
    return Trajectory(stamps_ns, np.array([at(*pose) for pose in driven.truth]))


def wheels_of(driven):
    return Trajectory(truth_of(driven).stamps_ns, np.array([at(*pose) for pose in driven.wheels]))


def built(path, out):
    log = open_source(path)
    return build(log, load_config(None, ["mcap.frame_times=false"], sensor=log.sensor), out)


def error_m(trajectory, driven):
    return evaluate(trajectory, truth_of(driven)).ate_m


@pytest.fixture(scope="module", params=["360° at 8 Hz, ROS 2", "180° at 5 Hz, CARMEN"])
def rooms(request, tmp_path_factory):
    """Two rooms twice around, with wheels that slip by 5 %."""
    folder = tmp_path_factory.mktemp("flat")
    if "ROS" in request.param:
        driven = drive(flat(), RPLIDAR, speed_mps=1.2)
        path = write_ros(folder / "log", driven)
    else:
        driven = drive(flat(), SICK, speed_mps=0.7)
        path = write_carmen(folder / "log.log", driven)
    return driven, built(path, folder / "run")


def test_poses_are_a_hundredth_as_wrong_as_the_wheels(rooms):
    driven, run = rooms

    assert error_m(wheels_of(driven), driven) > 0.3
    assert error_m(run.trajectory, driven) < 0.02
    assert len(run.trajectory) > 0.98 * len(driven.times_s)


def test_poses_stay_in_the_plane(rooms):
    _, run = rooms
    T = run.trajectory.T_world_body

    assert np.ptp(T[:, 2, 3]) < 1e-6
    assert np.abs(T[:, 2, 2] - 1.0).max() < 1e-9


def test_loops_hold_and_the_run_is_trusted(rooms):
    driven, run = rooms
    truth = truth_of(driven)
    index = {int(stamp_ns): k for k, stamp_ns in enumerate(truth.stamps_ns)}
    accepted = [loop for loop in run.loops if loop.verdict == "accepted"]

    assert len(accepted) >= 2
    for loop in accepted:
        T_i, T_j = (truth.T_world_body[index[ns]] for ns in (loop.stamp_i_ns, loop.stamp_j_ns))
        assert np.linalg.norm((np.linalg.inv(loop.T_i_j) @ np.linalg.inv(T_i) @ T_j)[:2, 3]) < 0.1
    assert run.manifest.verdict.state == "trusted"


def test_octree_is_one_layer_and_the_slice_is_as_sharp_as_its_cells(rooms):
    _, run = rooms
    heights_m = run.octree.occupied()[:, 2]
    grid = read_grid(run.path / "slice.yaml")

    assert np.ptp(heights_m) < 1e-6
    occupied = (grid.cells == OCCUPIED).sum() * grid.resolution_m
    walls_m = sum(np.linalg.norm(wall[2:] - wall[:2]) for wall in flat()[0])
    assert occupied < 2.5 * walls_m


def test_free_cells_of_the_layer_are_floor(rooms):
    _, run = rooms
    grid = read_grid(run.path / "traversable.yaml")
    x, y = run.trajectory.positions_world[::5, :2].T
    columns = ((x - grid.origin_world_m[0]) / grid.resolution_m).astype(int)
    rows = ((y - grid.origin_world_m[1]) / grid.resolution_m).astype(int)

    assert (grid.cells[rows, columns] == FREE).all()
    assert (grid.cells == OCCUPIED).any()


def test_wheels_measure_the_length_of_a_bare_corridor(tmp_path):
    driven = drive(corridor(20.0), RPLIDAR, speed_mps=1.6)

    run = built(write_ros(tmp_path / "log.bag", driven), tmp_path / "run")

    assert len(run.trajectory) > 0.95 * len(driven.times_s)
    assert error_m(run.trajectory, driven) < 0.5 * error_m(wheels_of(driven), driven)


def test_walls_alone_place_scans_without_wheels(tmp_path):
    driven = drive(flat(), SICK, speed_mps=0.7)
    path = write_carmen(tmp_path / "log.log", replace(driven, readings=np.zeros_like(driven.readings)))

    run = built(path, tmp_path / "run")

    assert error_m(run.trajectory, driven) < 0.03
    assert len(run.trajectory) > 0.95 * len(driven.times_s)


def tracked(log, *overrides):
    config = load_config(None, list(overrides), sensor=log.sensor)
    return track_log(log, config, progress=SILENT)


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """The first scans in a corridor without doors."""
    driven = drive(corridor(20.0), RPLIDAR, speed_mps=1.6).part(40)
    return open_source(write_ros(tmp_path_factory.mktemp("bare") / "log.bag", driven))


def test_wheels_that_are_not_used_predict_no_scan(bare):
    unused, without = tracked(bare, "graph.wheels.use=false"), tracked(replace(bare, wheels=None))

    np.testing.assert_array_equal(unused.trajectory().T_world_body, without.trajectory().T_world_body)


def test_noise_of_the_wheels_is_that_of_poses_that_no_wall_shows(bare):
    sure, unsure = (
        max(1.0 / factor.information[3, 3] for factor in tracked(bare, *overrides).graph.factors)
        for overrides in ([], ["graph.wheels.path_share=0.5"])
    )

    assert unsure > 4.0 * sure


@pytest.mark.parametrize("rooms", ["360° at 8 Hz, ROS 2"], indirect=True)
def test_another_drive_is_localised_in_the_map(rooms, tmp_path):
    driven, run = rooms
    again = drive(flat(), driven.laser, speed_mps=1.0, seed=5)
    known = load_known_map(run.path)

    localise(open_source(write_ros(tmp_path / "log", again)), known, known.config, tmp_path / "run")

    truth, own = truth_of(driven), run.trajectory
    true = truth.positions_world[nearest(truth.stamps_ns, own.stamps_ns)[0]]
    T_map_truth, _ = fit_rigid(own.positions_world, true)
    poses = read_tum(tmp_path / "run" / "trajectory.tum")
    want = truth_of(again).moved(T_map_truth)
    misses = poses.positions_world - want.positions_world[nearest(want.stamps_ns, poses.stamps_ns)[0]]
    assert len(poses) > 0.9 * len(again.times_s)
    assert np.median(np.linalg.norm(misses, axis=1)) < 0.05
