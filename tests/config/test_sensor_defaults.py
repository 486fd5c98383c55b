"""What a sensor's logs begin with, and how a user's words stand over it."""

import pytest

from mapper.config.loading import load_config, load_source_config
from mapper.core.errors import ConfigError
from tests.support.paths import CONFIGS


def test_an_rgbd_log_has_the_plain_defaults():
    assert load_config(sensor="rgbd") == load_config()


def test_a_lidar_log_is_placed_by_gicp_in_a_coarser_map():
    config = load_config(sensor="lidar")

    assert config.odometry.kind == "gicp"
    assert config.loops.kind == "scans"
    assert config.octree.resolution_m == 0.2
    assert config.slice.above == "ground"


def test_one_knob_turned_leaves_the_sensors_others(tmp_path):
    path = tmp_path / "street.toml"
    path.write_text("[octree]\nresolution_m = 0.1\n")

    config = load_config(path, ["slice.max_height_m=3.0"], sensor="lidar")

    assert config.octree.resolution_m == 0.1
    assert config.octree.max_range_m == 80.0
    assert config.slice.max_height_m == 3.0
    assert config.slice.min_height_m == 0.3


def test_another_kind_takes_its_own_defaults():
    config = load_config(None, ["odometry.kind=kiss-icp", "loops.kind=none"], sensor="lidar")

    assert config.odometry.kind == "kiss-icp"
    assert config.odometry.map_voxel_m == 1.0
    assert config.loops.kind == "none"


def test_the_source_is_known_before_the_sensor(tmp_path):
    path = tmp_path / "street.toml"
    path.write_text("[source]\nstride = 2\n[odometry]\ncell_m = 0.4\n")  # a knob that no RGB-D odometry has

    source = load_source_config(path, ["source.first_frame=3", "odometry.voxel_m=0.3"])

    assert (source.stride, source.first_frame) == (2, 3)
    assert load_config(path, sensor="lidar").odometry.cell_m == 0.4


def test_a_wrong_knob_of_the_source_is_named():
    with pytest.raises(ConfigError, match=r"source\.strid"):
        load_source_config(None, ["source.strid=2"])


def test_the_outdoor_file_spells_the_defaults_out():
    path = CONFIGS / "lidar_outdoor.toml"

    assert load_config(path, sensor="lidar") == load_config(sensor="lidar")
