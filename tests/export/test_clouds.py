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
