"""What LiDAR drivers record in messages of their own is read as the clouds that they mean."""

import sys

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mapper.config.loading import load_config
from mapper.core.errors import DataError, DependencyError
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.pipeline.build import build
from mapper.sources import open_source
from mapper.sources.inspection import inspect_log
from mapper.sources.ros.decode_ros import decode_driver_message
from mapper.sources.ros.recording import Topic
from tests.support.driver_recordings import FIRST_NS, street, write_livox, write_vlp16


@pytest.fixture(scope="module")
def simulator():
    return street()


@pytest.mark.parametrize(
    ("name", "package"),
    [
        ("a.bag", "livox_ros_driver"),
        ("a", "livox_ros_driver"),
        ("a", "livox_ros_driver2"),
        ("b.bag", "my_livox"),
    ],
)
@pytest.mark.parametrize("frame", ["livox_frame", "four"])  # lengths that shift what follows
def test_livox_points_and_times_are_read_bit_by_bit(tmp_path, simulator, name, package, frame):
    scans = [simulator.observe(i) for i in range(2)]
    log = open_source(write_livox(tmp_path / name, scans, package=package, frame=frame))
    assert (log.sensor, len(log)) == ("lidar", 2)
    for scan, expected in zip(log, scans, strict=True):
        assert scan.stamp_ns == expected.stamp_ns
        np.testing.assert_array_equal(scan.points_body, expected.points_body)
        np.testing.assert_allclose(scan.times_s, expected.times_s, atol=1e-8)


def test_what_a_livox_tags_as_noise_is_left_out(tmp_path, simulator):
    scans = [simulator.observe(0)]
    tags = (0b000000, 0b010000, 0b000001, 0b000100, 0b100000)
    log = open_source(write_livox(tmp_path / "a", [*scans, simulator.observe(1)], tags=tags))
    points = scans[0].points_body
    kept = np.isin(np.arange(len(points)) % 5, [0, 1, 4])
    np.testing.assert_array_equal(log[0].points_body, points[kept])
    assert any(f"{(~kept).sum()} of {len(points)}" in note for note in log.notes)


def test_a_livox_recording_is_mapped(tmp_path, simulator):
    path = write_livox(tmp_path / "a.bag", [simulator.observe(i) for i in range(12)])
    truth = simulator.truth
    run = build(open_source(path), load_config(None, sensor="lidar"), tmp_path / "run")
    assert len(run.trajectory) == 12
    errors_m = np.linalg.norm(np.diff(run.trajectory.positions_world, axis=0), axis=1) - np.linalg.norm(
        np.diff(truth.positions_world[:12], axis=0), axis=1
    )
    assert np.abs(errors_m).max() < 0.03


@pytest.mark.parametrize("name", ["a.bag", "a"])
def test_packets_of_a_vlp16_are_decoded(tmp_path, simulator, name):
    path, truth = write_vlp16(tmp_path / name, simulator, scans=2)
    log = open_source(path)
    assert log.stamps_ns.tolist() == truth.stamps_ns.tolist()
    scan = log[1]
    assert -0.1 < scan.times_s.min() < -0.098
    assert 0.0 < scan.times_s.max() < 0.0014
    before_world, points_world = (_in_world(simulator, one) for one in (log[0], scan))
    apart_m, _ = cKDTree(before_world).query(points_world)
    assert np.median(apart_m) < 0.1


def _in_world(simulator, scan):
    """Return the points where the simulated vehicle was when each was measured."""
    poses = simulator.drive.poses((scan.stamp_ns - FIRST_NS) / 1e9 + scan.times_s.astype(np.float64))
    return np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points_body) + poses[:, :3, 3]


def test_packets_are_mapped(tmp_path, simulator):
    path, truth = write_vlp16(tmp_path / "a.bag", simulator, scans=12)
    run = build(open_source(path), load_config(None, sensor="lidar"), tmp_path / "run")
    assert evaluate(run.trajectory, truth).ate_m < 0.03


def test_packets_without_their_library_are_refused_with_the_install_line(tmp_path, simulator, monkeypatch):
    path, _ = write_vlp16(tmp_path / "a.bag", simulator, scans=2)
    monkeypatch.setitem(sys.modules, "velodyne_decoder", None)
    monkeypatch.setattr("mapper.runtime.extras.find_spec", lambda _: None)
    with pytest.raises(DependencyError, match=r"packets needs .*pip install .*\[velodyne\]"):
        open_source(path)
    assert "[velodyne]" in inspect_log(path, config=load_config(None).source).problem


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
@pytest.mark.parametrize("type_", ["livox_ros_driver/msg/CustomMsg", "velodyne_msgs/msg/VelodyneScan"])
@pytest.mark.parametrize("size", [0, 3, 12, 17, 24, 40, 200, 1300])
def test_damaged_messages_are_refused(encoding, type_, size):
    data = memoryview(b"\0\1" + bytes(range(1, 255)) * 8)[:size]
    with pytest.raises((DataError, ValueError, IndexError)):
        decode_driver_message(Topic("/t", type_, encoding), data)
