"""Clouds in other programs' files, read by the libraries of these formats."""

import laspy
import numpy as np
import pytest
import yaml
from pypcd4 import PointCloud

from mapper.config.loading import load_config
from mapper.export.exporters import export
from mapper.pipeline.build import build
from mapper.sources import open_source
from tests.support.street_scans import SENSOR, on_street, still_scan, street


@pytest.fixture(scope="module")
def run(desk_log, tmp_path_factory):
    """A run whose octree has times and hits."""
    config = load_config(None, ["source.last_frame=12", "octree.resolution_m=0.1", "octree.attributes=true"])
    return build(open_source(desk_log, config.source), config, tmp_path_factory.mktemp("clouds") / "run")


def assert_attributes(run, hits, times_s):
    at = run.octree.attributes.at(run.cloud.points.astype(np.float64))
    np.testing.assert_array_equal(hits, at.hits)
    assert hits.min() >= 1
    stamps_ns = run.trajectory.stamps_ns
    np.testing.assert_allclose(times_s, (at.last_seen_ns - stamps_ns[0]) / 1e9)
    assert 0.0 <= times_s.min() < times_s.max() <= (stamps_ns[-1] - stamps_ns[0]) / 1e9


@pytest.mark.parametrize("ending", [".las", ".laz"])
def test_las(run, tmp_path, ending):
    cloud = laspy.read(export(run, "las", tmp_path / f"cloud{ending}"))
    assert (cloud.header.version.major, cloud.header.version.minor, cloud.point_format.id) == (1, 2, 2)
    assert cloud.header.generating_software == "mapper"
    assert (tmp_path / f"cloud{ending}").read_bytes()[90:94] == bytes(
        4
    )  # no date: the same run, the same bytes
    assert cloud.header.are_points_compressed == (ending == ".laz")
    np.testing.assert_allclose(cloud.xyz, run.cloud.points, atol=0.51e-4)
    np.testing.assert_array_equal(
        np.column_stack([cloud.red, cloud.green, cloud.blue]) // 256, run.cloud.colors
    )
    assert cloud.red.max() > 255
    assert_attributes(run, np.array(cloud.hits), np.array(cloud.last_seen_s))


def test_pcd(run, tmp_path):
    cloud = PointCloud.from_path(export(run, "pcd", tmp_path / "cloud.pcd"))
    assert cloud.fields == ("x", "y", "z", "rgb", "time_s", "last_seen_s", "hits")
    np.testing.assert_array_equal(cloud.numpy(("x", "y", "z")), run.cloud.points)
    packed = np.ascontiguousarray(cloud.pc_data["rgb"]).view(np.uint32)
    np.testing.assert_array_equal(
        np.column_stack([packed >> 16, packed >> 8 & 255, packed & 255]), run.cloud.colors
    )
    assert_attributes(run, cloud.pc_data["hits"], cloud.pc_data["last_seen_s"])


def test_autoware_tiles_hold_the_points_that_their_metadata_says(lidar_run, tmp_path):
    run = lidar_run
    folder = export(run, "autoware", tmp_path / "map")
    metadata = yaml.safe_load((folder / "pointcloud_map_metadata.yaml").read_text())
    size = metadata.pop("x_resolution"), metadata.pop("y_resolution")
    assert size == (20.0, 20.0)
    assert set(metadata) == {path.name for path in (folder / "pointcloud_map.pcd").iterdir()}
    count = 0
    for name, corner in metadata.items():
        assert all(isinstance(value, int) for value in corner)  # as Autoware reads them
        points = PointCloud.from_path(folder / "pointcloud_map.pcd" / name).numpy(("x", "y"))
        assert ((points >= corner) & (points < np.add(corner, size))).all()
        count += len(points)
    assert count == len(run.cloud)
    projector = yaml.safe_load((folder / "map_projector_info.yaml").read_text())
    assert projector == {"projector_type": "Local"}


@pytest.fixture(scope="module")
def lidar_run(tmp_path_factory):
    """A run of scans in KITTI's records, of which each point's intensity is its range over 100 m."""
    folder = tmp_path_factory.mktemp("intensities")
    (folder / "velodyne").mkdir()
    for k in range(10):
        points = still_scan(street(7), SENSOR, on_street(street(7), 20.0 + 0.5 * k), seed=k)
        records = np.column_stack([points, np.linalg.norm(points, axis=1) / 100.0]).astype("<f4")
        records.tofile(folder / "velodyne" / f"{k:06d}.bin")
    config = load_config(None, [], sensor="lidar")
    return build(open_source(folder, config.source), config, folder / "run")


def test_intensities_come_along(lidar_run, tmp_path):
    cloud = lidar_run.cloud
    ranges_m = np.linalg.norm(cloud.points - lidar_run.trajectory.positions_world[5], axis=1)
    assert cloud.intensities is not None
    assert np.abs(100.0 * cloud.intensities - ranges_m).max() < 4.0
    las = laspy.read(export(lidar_run, "las", tmp_path / "cloud.laz"))
    np.testing.assert_allclose(las.intensity / 65535.0, cloud.intensities, atol=1e-5)
    pcd = PointCloud.from_path(export(lidar_run, "pcd", tmp_path / "cloud.pcd"))
    np.testing.assert_array_equal(pcd.pc_data["intensity"], cloud.intensities)
