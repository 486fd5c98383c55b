"""Clouds in other programs' files, read by the libraries of these formats."""

import laspy
import numpy as np
import pytest
from pypcd4 import PointCloud

from mapper.config.loading import load_config
from mapper.export.exporters import export
from mapper.pipeline.build import build
from mapper.sources import open_source


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
    assert_attributes(run, np.array(cloud.hits), np.array(cloud.time_s))


def test_pcd(run, tmp_path):
    cloud = PointCloud.from_path(export(run, "pcd", tmp_path / "cloud.pcd"))
    assert cloud.fields == ("x", "y", "z", "rgb", "time_s", "hits")
    np.testing.assert_array_equal(cloud.numpy(("x", "y", "z")), run.cloud.points)
    packed = np.ascontiguousarray(cloud.pc_data["rgb"]).view(np.uint32)
    np.testing.assert_array_equal(
        np.column_stack([packed >> 16, packed >> 8 & 255, packed & 255]), run.cloud.colors
    )
    assert_attributes(run, cloud.pc_data["hits"], cloud.pc_data["time_s"])
