"""Recordings of public bug reports in ../shared/cases: what each states is used, or refused by its cause."""

import json
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import GraphError, MapperError, SourceError
from mapper.core.frames import RgbdFrame
from mapper.graph.config import GraphConfig
from mapper.graph.g2o import read_g2o
from mapper.graph.optimize import optimize
from mapper.pipeline.build import build
from mapper.sources import open_source
from mapper.sources.config import CameraConfig, SourceConfig
from mapper.sources.depth_scale import depth_warnings, read_spread
from mapper.sources.inspection import inspect_log
from tests.support.paths import CONFIGS, SHARED

OF_ITS_OWN_STREAM = r"focal length 63\.0 px\) is not registered to .*78\.8 px"


def case(name: str) -> Path:
    path = SHARED / "cases" / name
    if not path.exists():
        pytest.skip(f"{path} is not here")
    return path


def build_case(name: str, out: Path) -> None:
    log = open_source(case(name), SourceConfig())
    build(log, load_config(None, sensor=log.sensor), out)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("01_realsense_viewer_bag/viewer.bag", OF_ITS_OWN_STREAM),
        ("01_realsense_viewer_bag/same_frame_ids.bag", OF_ITS_OWN_STREAM),
        ("12_h264_colour/bag", "h264"),
    ],
)
def test_what_cannot_be_mapped_is_refused_by_its_cause(name, why):
    with pytest.raises(SourceError, match=why):
        open_source(case(name), SourceConfig())


def test_depth_in_millimetres_that_is_read_as_tum_s_units_is_doubted():
    log = open_source(case("02_own_dataset_with_associations_in_mm/log"), SourceConfig())
    assert len(depth_warnings(log, read_spread(log))) == 1
    right = SourceConfig(camera=CameraConfig(depth_factor=1000.0))
    right_log = open_source(log.path, right)
    assert depth_warnings(right_log, read_spread(right_log)) == []


@pytest.mark.parametrize("name", ["ros2", "foxglove.mcap"])
def test_a_sixteen_bit_png_is_depth(name):
    log = open_source(case(f"03_depth_png_as_compressed_image/{name}"), SourceConfig())
    frame = log[0]
    assert len(log) == 12
    assert isinstance(frame, RgbdFrame)
    assert 0.5 < np.median(frame.depth_m[frame.depth_m > 0.0]) < 8.0


def test_clouds_of_two_lidars_lie_in_one_body_frame():
    scans = list(open_source(case("04_two_lidars_one_topic/bag"), SourceConfig(body_frame="base_link")))
    origins = np.array([scan.origin_body for scan in scans])
    assert len(np.unique(origins.round(3), axis=0)) == 2
    # Twice the lever arm would separate them if each were read in the other's frame.
    floors_m = [float(np.percentile(scan.points_body[:, 2], 1.0)) for scan in scans]
    assert np.ptp(floors_m) < 0.1


@pytest.mark.parametrize("name", ["05_clouds_in_the_world_frame/bag", "18_utm_clouds_in_a_bag/bag"])
def test_clouds_in_a_frame_that_stays_are_refused_unless_the_user_says_they_move(name):
    path = case(name)
    found = inspect_log(path, SourceConfig())
    assert found.log is None
    frame = "utm" if "utm" in name else "camera_init"
    assert f"frame {frame}," in found.problem
    assert len(open_source(path, SourceConfig(body_frame=frame))) == 10


def test_inspect_refuses_clouds_whose_returns_are_all_out_of_reach():
    found = inspect_log(case("18_utm_clouds_in_a_bag/bag"), SourceConfig(body_frame="utm"))
    assert "450 returns" in found.problem


def test_edges_between_neighbouring_vertices_are_odometry_whatever_their_ids():
    folder = case("06_g2o_ids_in_tens")
    truth_world = np.load(folder / "truth.npy")[:, :3, 3]
    for name in ("ids_in_tens", "consecutive_ids"):
        graph = read_g2o(folder / f"{name}.g2o", guess_loops=True)
        solution = optimize(graph, GraphConfig(robust="gnc"))
        assert len(graph.loops) == 32
        assert sum(weight > 0.5 for weight in solution.weights) == 59 + 10
        found_world = np.array([T[:3, 3] for T in solution.T_world_node.values()])
        steps_m = [np.linalg.norm(np.diff(path, axis=0), axis=1) for path in (found_world, truth_world)]
        np.testing.assert_allclose(steps_m[0], steps_m[1], atol=0.1)


def test_a_binned_camera_s_intrinsics_are_its_images():
    camera = open_source(case("07_binning/binning2"), SourceConfig())[0].camera
    np.testing.assert_allclose(camera.intrinsics, [131.263, 131.263, 79.5, 59.5], atol=0.001)


def test_eight_coefficients_are_taken_out_of_the_images():
    log = open_source(case("08_rational_polynomial/bag"), SourceConfig())
    frame = log[0]
    assert not any(frame.camera.distortion)
    assert (frame.depth_m > 0.0).mean() > 0.8
    assert sum("rational_polynomial" in note for note in log.notes) == 1


def test_the_bags_of_a_split_recording_are_joined():
    folder = case("09_folder_of_split_bags/log")
    parts = [open_source(path, SourceConfig()) for path in sorted(folder.glob("*.bag"))]
    log = open_source(folder, SourceConfig())
    assert log.kind == "rosbag"
    np.testing.assert_array_equal(log.stamps_ns, np.concatenate([part.stamps_ns for part in parts]))


@pytest.mark.parametrize(
    ("name", "points", "named"),
    [
        ("10_row_step_wrong/half", 672, "row_step"),
        ("10_row_step_wrong/whole", 672, "row_step"),
        ("17_field_of_unknown_datatype/bag", 675, "intensity"),
    ],
)
def test_clouds_that_contradict_themselves_are_read_and_what_is_wrong_is_named(name, points, named):
    log = open_source(case(name), SourceConfig())
    assert {len(scan.points_body) for scan in log} == {points}
    assert sum(named in note for note in log.notes) == 1


def test_headers_that_all_have_stamp_0_leave_the_times_of_recording():
    log = open_source(case("11_header_stamps_zero/bag"), SourceConfig())
    np.testing.assert_allclose(np.diff(log.stamps_ns), 1e8, atol=2e7)
    assert [scan.stamp_ns for scan in log] == log.stamps_ns.tolist()
    assert not [sentence for sentence in log.sentences if "clock of" in sentence and "own" in sentence]


def test_float_depth_in_millimetres_is_refused_and_the_setting_reads_it():
    path = case("14_32FC1_in_millimetres/bag")
    assert "depth_factor=1000" in inspect_log(path, SourceConfig()).problem
    right = SourceConfig(camera=CameraConfig(depth_factor=1000.0))
    assert inspect_log(path, right).problem is None


def test_a_counter_that_wraps_costs_no_point():
    log = open_source(case("15_point_times_partly_wrong/wrapped"), SourceConfig())
    assert all(scan.untimed_returns == 0 and np.ptp(scan.times_s) < 0.11 for scan in log)
    assert sum("begins anew" in note for note in log.notes) == 1


def test_nanoseconds_without_leading_zeros_are_whole_numbers():
    log = open_source(case("16_unpadded_nanoseconds/scans"), SourceConfig())
    np.testing.assert_array_equal(np.diff(log.stamps_ns), 100_000_000)


def test_other_programs_graphs_are_read_or_refused_by_their_cause():
    folder = case("19_g2o_of_other_programs")
    for name in ("priors", "noinfo"):
        graph = read_g2o(folder / f"{name}.g2o")
        assert (len(graph.T_world_node), len(graph.factors)) == (60, 69)
    with pytest.raises(GraphError, match="comma"):
        read_g2o(folder / "comma.g2o")


def test_accelerations_in_g_are_converted():
    log = open_source(case("21_imu_in_g/bag.bag"), SourceConfig())
    lengths = np.linalg.norm(log.accelerations.acceleration_mps2, axis=1)
    np.testing.assert_allclose(np.median(lengths), 9.81, atol=0.1)


REFUSED = {
    "01_realsense_viewer_bag/viewer.bag",
    "01_realsense_viewer_bag/same_frame_ids.bag",
    "05_clouds_in_the_world_frame/bag",
    "12_h264_colour/bag",
    "14_32FC1_in_millimetres/bag",
    "18_utm_clouds_in_a_bag/bag",
}
MAPPED = {
    "02_own_dataset_with_associations_in_mm/log",
    "03_depth_png_as_compressed_image/ros2",
    "04_two_lidars_one_topic/bag",
    "07_binning/binning2",
    "08_rational_polynomial/bag",
    "09_folder_of_split_bags/log",
    "10_row_step_wrong/half",
    "11_header_stamps_zero/bag",
    "15_point_times_partly_wrong/wrapped",
    "17_field_of_unknown_datatype/bag",
    "20_upside_down_lidar/imu_mps2.bag",
    "21_imu_in_g/bag.bag",
}


@pytest.mark.parametrize("name", sorted(REFUSED | MAPPED))
def test_inspect_refuses_what_a_build_must_refuse(tmp_path, name):
    problem = inspect_log(case(name), SourceConfig()).problem
    assert (problem is not None) == (name in REFUSED)
    if problem is None:
        return
    for internal in ("stride", "index out of range", "offset", "16 bits", "itemsize", "more of the log"):
        assert internal not in problem
    with pytest.raises(MapperError):
        build_case(name, tmp_path / "run")


@pytest.fixture(scope="module")
def corridor(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corridor")
    subprocess.run([sys.executable, case("23_bare_corridor") / "make.py"], cwd=folder, check=True)
    return folder / "corridor"


@pytest.mark.slow
@pytest.mark.parametrize("voxel_m", [0.1, 0.15, 0.4, 0.8])
def test_a_corridor_that_shows_no_motion_along_it_is_not_trusted_at_any_voxel_size(
    corridor, tmp_path, voxel_m
):
    with suppress(MapperError):  # too few frames are tracked
        log = open_source(corridor, SourceConfig())
        indoor = load_config(CONFIGS / "lidar_indoor.toml", [f"odometry.voxel_m={voxel_m}"], sensor="lidar")
        build(log, indoor, tmp_path / "run")
    (manifest,) = tmp_path.glob("run*/manifest.json")
    frames = json.loads(manifest.read_text())["counts"]
    assert frames["tracked"] <= 10
    assert frames["tracked"] + frames["doubtful"] == 80


@pytest.mark.parametrize("is_mounting_stated", [True, False])
def test_an_inverted_lidar_is_levelled_with_its_z_axis_down(tmp_path, is_mounting_stated):
    log = open_source(case("20_upside_down_lidar/imu_mps2.bag"), SourceConfig())
    if not is_mounting_stated:
        log = replace(log, T_base_body=None)
    run = build(log, load_config(None, sensor=log.sensor), tmp_path / "run")
    T_world_body = run.trajectory.T_world_body
    assert (T_world_body[:, 2, 2] < -0.99).all()
    assert (T_world_body[:, 2, 3] > 1.0).all()
    warned = [warning.kind for warning in run.manifest.warnings if warning.kind == "level"]
    assert len(warned) == (0 if is_mounting_stated else 1)
