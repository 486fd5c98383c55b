"""A damaged return that is farther than any sensor reaches costs itself, not the build."""

from pathlib import Path

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.pipeline.build import build
from mapper.simulation.config import STREET, LidarSensorConfig
from mapper.simulation.lidar import write_lidar_log
from mapper.sources import open_source
from mapper.sources.cloud_files import ENDINGS
from mapper.sources.ros.cloud_messages import scan_from
from mapper.sources.ros.decode_ros import decode_ros
from mapper.sources.ros.encode_ros import cloud_message
from mapper.sources.ros.recording import Topic
from mapper.sources.scan_folders.scans import read_scan
from mapper.sources.valid_returns import FARTHEST_M
from tests.support.clouds import save_cloud
from tests.support.progress import Observer


def sweep(n: int = 200) -> np.ndarray:
    return np.random.default_rng(0).uniform(-20.0, 20.0, (n, 3)).astype(np.float32)


@pytest.mark.parametrize("ending", ENDINGS)
def test_far_returns_of_a_file_are_left_out_and_counted(tmp_path, ending):
    points = sweep().round(1)  # every format keeps that
    points[17] = FARTHEST_M, 0.0, -100.0
    if ending not in (".las", ".laz"):  # whose coordinates are 32 bits times a scale
        points[40] = 1e30, -1e30, 1.0
    path = tmp_path / f"1{ending}"
    save_cloud(path, points)
    scan = read_scan(path)
    far = np.linalg.norm(points.astype(np.float64), axis=1) >= FARTHEST_M
    assert scan.far_returns == far.sum() >= 1
    np.testing.assert_allclose(scan.points_body, points[~far], atol=1e-4)


def test_times_and_colours_stay_with_their_points(tmp_path):
    points = np.zeros(
        100, [*((name, "f4") for name in "xyzt"), *((c, "u1") for c in ("red", "green", "blue"))]
    )
    for axis, values in zip("xyz", sweep(100).T, strict=True):
        points[axis] = values
    points["t"] = np.linspace(0.0, 0.099, 100)
    points["red"] = np.arange(100)
    points["x"][30] = 7000.0
    np.save(tmp_path / "1.npy", points)
    scan = read_scan(tmp_path / "1.npy")
    assert scan.far_returns == 1
    np.testing.assert_array_equal(scan.colors[:, 0], np.delete(np.arange(100), 30))
    np.testing.assert_allclose(scan.times_s, np.delete(points["t"], 30), atol=1e-6)
    np.save(tmp_path / "2.npy", sweep(100) * 1000.0 + 1e4)
    with pytest.raises(FrameError, match=r"2\.npy: 100 of 100 points are farther than 5000 m"):
        read_scan(tmp_path / "2.npy", scale=1.0)


def test_far_returns_of_a_message_are_left_out_and_counted():
    points = sweep()
    points[5], points[6], points[7] = (6000.0, 0.0, 0.0), (0.0, -3e38, 0.0), (0.0, 0.0, 0.0)
    data = memoryview(cloud_message("/points", Scan(0, points), frame="lidar").cdr)
    message = decode_ros(Topic("/points", "sensor_msgs/msg/PointCloud2", "cdr"), data)
    scan = scan_from(message, T_body_frame=np.eye(4), with_colours=True, where="m")
    assert scan.far_returns == 2  # the point at the sensor is a missing return
    np.testing.assert_array_equal(scan.points_body, np.delete(points, [5, 6, 7], axis=0))


def test_a_cloud_of_the_other_order_of_bytes_is_refused(tmp_path):
    points = sweep().byteswap()
    np.save(tmp_path / "1.npy", points)
    with pytest.raises(FrameError, match="points are farther than 5000 m"):
        read_scan(tmp_path / "1.npy", scale=1.0)
    data = memoryview(
        cloud_message("/points", Scan(0, points[np.isfinite(points).all(axis=1)]), frame="a").cdr
    )
    message = decode_ros(Topic("/points", "sensor_msgs/msg/PointCloud2", "cdr"), data)
    with pytest.raises(FrameError, match="is_bigendian"):
        scan_from(message, T_body_frame=np.eye(4), with_colours=False, where="m", scale=1.0)


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> Path:
    """A short drive whose scan 3 has a return at 6 km, and scan 4 one at 4 km."""
    log = tmp_path_factory.mktemp("logs") / "street"
    sensor = LidarSensorConfig(rings=16, azimuth_steps=450)
    write_lidar_log(log, STREET.model_copy(update={"duration_s": 1.0, "sensor": sensor}))
    for number, far_m in ((3, 6000.0), (4, 4000.0)):
        path = log / f"velodyne/{number:06}.npy"
        points = np.load(path)
        points["x"][10], points["y"][10], points["z"][10] = far_m, 0.0, 0.0
        np.save(path, points)
    return log


def test_a_far_return_does_not_end_a_build(street, tmp_path):
    source, progress = open_source(street), Observer()
    config = load_config(None, ["octree.resolution_m=0.1"], sensor="lidar")
    run = build(source, config, tmp_path / "run", progress=progress)
    assert run.manifest.counts.tracked == len(source) == 11
    beyond = (
        "1 points lie farther than 3276.8 m from the map's origin, beyond the reach of 0.1 m voxels; left out"
    )
    assert beyond in progress.notes
