"""Frames of a robot: the poses of its base, where a log says where the sensor is on it."""

from dataclasses import replace
from shutil import copytree

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from mapper.config.build import BuildConfig
from mapper.core.frames import PinholeCamera
from mapper.core.geometry import exp, inverse
from mapper.core.rotations import rotation_from_quaternion
from mapper.core.trajectory import Trajectory
from mapper.export.exporters import export
from mapper.export.mcap_log import McapLog
from mapper.export.part_of_run import part_of
from mapper.export.run_maps import read_snapshots
from mapper.export.transforms import transforms_of
from mapper.pipeline.build import build
from mapper.pipeline.fuse import fuse
from mapper.run import files
from mapper.run.folder import open_run
from mapper.run.manifest_logs import AppendedLog, RobotFrames
from mapper.sources import open_source
from mapper.sources.base import MountedSensor
from mapper.sources.config import SourceConfig
from mapper.sources.trajectory_files import read_tum

T_BASE_BODY = exp(np.array([1.2, -1.2, 1.2]), np.array([0.2, 0.0, 1.1]))
T_PARENT_LASER = exp(np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.1, -0.4]))


@pytest.fixture(scope="module")
def run(desk_log, tmp_path_factory):
    log = open_source(desk_log, SourceConfig(last_frame=9))
    sensors = [MountedSensor("laser", "optical", T_PARENT_LASER)]
    mounted = replace(
        log, T_base_body=T_BASE_BODY, base_frame="base_link", body_frame="optical", sensors=sensors
    )
    return build(mounted, BuildConfig(), tmp_path_factory.mktemp("run") / "run")


def matrix_of(t, q):
    T = np.eye(4)
    T[:3, :3] = rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w]))
    T[:3, 3] = t.x, t.y, t.z
    return T


def transforms_of_bag(run, tmp_path):
    """Return {(parent, child): {stamp, or 0 of those that stay: T_parent_child}} of a run exported to ROS."""
    found = {}
    with AnyReader([export(run, "rosbag2", tmp_path / "bag")]) as reader:
        for connection, stamp_ns, data in reader.messages():
            if connection.topic in ("/tf", "/tf_static"):
                for one in reader.deserialize(data, connection.msgtype).transforms:
                    place = found.setdefault((one.header.frame_id, one.child_frame_id), {})
                    T = matrix_of(one.transform.translation, one.transform.rotation)
                    place[stamp_ns if connection.topic == "/tf" else 0] = T
    return found


def transforms_of_mcap(run, _tmp_path):
    """As ``transforms_of_bag``, of a run's MCAP log."""
    found = {}
    with run.file(files.MCAP).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, told in reader.iter_decoded_messages(topics=["/tf", "/tf_static"]):
            for one in [told] if channel.topic == "/tf" else told.transforms:
                place = found.setdefault((one.parent_frame_id, one.child_frame_id), {})
                T = matrix_of(one.translation, one.rotation)
                place[message.log_time if channel.topic == "/tf" else 0] = T
    return found


def chained(found, frame, stamp_ns):
    """Return T_map_frame at a stamp."""
    T_map_frame = np.eye(4)
    while frame != "map":
        ((parent, places),) = [(parent, T) for (parent, child), T in found.items() if child == frame]
        T_map_frame = places.get(0, places.get(stamp_ns)) @ T_map_frame
        frame = parent
    return T_map_frame


BOTH = pytest.mark.parametrize("transforms", [transforms_of_mcap, transforms_of_bag])


def test_a_run_has_the_poses_of_the_base(run):
    base = read_tum(run.file(files.BASE))
    np.testing.assert_array_equal(base.stamps_ns, run.trajectory.stamps_ns)
    np.testing.assert_allclose(
        base.T_world_body, run.trajectory.T_world_body @ inverse(T_BASE_BODY), atol=1e-12
    )


@BOTH
def test_viewers_get_the_base_in_the_map_and_the_sensors_on_it(run, tmp_path, transforms):
    found = transforms(run, tmp_path)
    assert {link: len(places) for link, places in found.items()} == {
        ("map", "base_link"): len(run.trajectory),
        ("base_link", "optical"): 1,
        ("optical", "laser"): 1,
    }
    for frame in ("body", "base", "laser"):
        poses = read_tum(export(run, "tum", tmp_path / f"{frame}.tum", poses_of=frame))
        assert len(poses) == len(run.trajectory)
        name = {"body": "optical", "base": "base_link"}.get(frame, frame)
        chains = [chained(found, name, stamp_ns) for stamp_ns in poses.stamps_ns.tolist()]
        np.testing.assert_allclose(chains, poses.T_world_body, atol=1e-9)


def test_poses_of_a_sensor_are_where_it_is_on_the_body(run, tmp_path):
    poses = read_tum(export(run, "tum", tmp_path / "a.tum", poses_of="laser", frame="start"))
    expected = inverse(run.trajectory[0]) @ run.trajectory.T_world_body @ T_PARENT_LASER
    np.testing.assert_allclose(poses.T_world_body, expected, atol=1e-9)


@pytest.fixture(scope="module")
def moving_run(desk_log, tmp_path_factory):
    log = open_source(desk_log, SourceConfig(last_frame=9))
    turns = np.array([exp(np.array([0.0, 0.1 * i, 0.0]), np.zeros(3)) for i in range(6)])
    T_body_base = Trajectory(log.stamps_ns[2:8], turns @ inverse(T_BASE_BODY))
    mounted = replace(
        log,
        T_body_base=T_body_base,
        base_frame="base_link",
        body_frame="optical",
        base_height_m=0.1,
        sensors=[MountedSensor("laser", "base_link", T_PARENT_LASER)],
    )
    return T_body_base, build(mounted, BuildConfig(), tmp_path_factory.mktemp("run") / "run")


def test_a_base_that_moves_below_the_sensor_has_poses_where_they_are_known(moving_run):
    T_body_base, run = moving_run
    base = read_tum(run.file(files.BASE))
    np.testing.assert_array_equal(base.stamps_ns, T_body_base.stamps_ns)
    expected = run.trajectory.T_world_body[2:8] @ T_body_base.T_world_body
    np.testing.assert_allclose(base.T_world_body, expected, atol=1e-9)
    robot = run.manifest.input.robot
    assert (robot.base, robot.body, robot.mounting) == ("base_link", "optical", None)


def test_it_keeps_its_place_below_the_sensor_when_the_run_is_fused_at_other_poses(moving_run, tmp_path):
    T_body_base, run = moving_run
    copy = open_run(copytree(run.path, tmp_path / "run"))
    moved = copy.trajectory.moved(exp(np.array([0.0, 0.0, 0.2]), np.array([1.0, 0.0, 0.0])))
    refused = fuse(copy.open_log(), copy, copy.config, trajectory=moved)
    base = read_tum(refused.file(files.BASE))
    expected = refused.trajectory.T_world_body[2:8] @ T_body_base.T_world_body
    np.testing.assert_allclose(base.T_world_body, expected, atol=1e-9)
    part = part_of(refused, "base", None)
    np.testing.assert_allclose(part.T_frame_map @ base.T_world_body[0], np.eye(4), atol=1e-9)


@BOTH
def test_viewers_get_such_a_base_on_the_body_at_its_stamps(moving_run, tmp_path, transforms):
    T_body_base, run = moving_run
    found = transforms(run, tmp_path)
    assert {link: len(places) for link, places in found.items()} == {
        ("map", "optical"): len(run.trajectory),
        ("optical", "base_link"): len(T_body_base),
        ("base_link", "laser"): 1,
    }
    laser = read_tum(export(run, "tum", tmp_path / "a.tum", poses_of="laser"))
    np.testing.assert_array_equal(laser.stamps_ns, T_body_base.stamps_ns)
    chains = [chained(found, "laser", stamp_ns) for stamp_ns in laser.stamps_ns.tolist()]
    np.testing.assert_allclose(chains, laser.T_world_body, atol=1e-9)


def test_another_place_of_the_sensor_in_a_later_log_leaves_the_base_out(run):
    known = run.manifest.input
    other = RobotFrames(base="base_link", body="optical", body_in_base=(0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
    assert known.robot_of_all == known.robot
    later = {
        "path": "b",
        "kind": "tum",
        "fingerprint": "",
        "source": SourceConfig(),
        "shift_ns": 0,
        "begins_ns": 0,
    }
    appended = known.model_copy(update={"appended": (AppendedLog(**later, robot=other),)})
    assert appended.robot_of_all is None


def test_sensors_that_a_later_log_lacks_are_left_out_and_not_the_base(run):
    known = run.manifest.input
    later = {"path": "b", "kind": "tum", "fingerprint": "", "source": SourceConfig(), "shift_ns": 0}
    robot = known.robot.model_copy(update={"sensors": ()})
    appended = known.model_copy(update={"appended": (AppendedLog(**later, begins_ns=0, robot=robot),)})
    assert appended.robot_of_all == robot


@pytest.mark.parametrize(("name", "shown"), [("", "body"), ("map", "body"), ("camera", "camera")])
def test_a_body_without_a_name_that_can_be_used_is_called_body(run, name, shown):
    log_input = run.manifest.input.model_copy(update={"robot": RobotFrames(body=name)})
    told = transforms_of(replace(run, manifest=run.manifest.model_copy(update={"input": log_input})))
    assert {link[:2] for _, links in told.moving for link in links} == {("map", shown)}


@pytest.mark.parametrize(("root", "body"), [("world", "body"), ("map", "camera")])
def test_images_are_read_with_the_camera_s_place_on_the_body(tmp_path, root, body):
    """Of runs from before the map was called map, too; a camera that is the body has no such place."""
    with McapLog(tmp_path / "run.mcap") as log:
        log.transform(0, T_BASE_BODY, parent=root, child=body)
        if body != "camera":
            log.transform(0, T_PARENT_LASER, parent=body, child="camera")
        log.calibration(0, PinholeCamera(64, 48, 60.0, 61.0, 31.5, 23.5), frame="camera")
        log.image(0, b"jpeg", frame="camera")
    (snapshot,) = read_snapshots(tmp_path / "run.mcap")
    expected = np.eye(4) if body == "camera" else T_PARENT_LASER
    np.testing.assert_allclose(snapshot.T_body_camera, expected, atol=1e-9)
