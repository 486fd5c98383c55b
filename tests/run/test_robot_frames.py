"""Frames of a robot: the poses of its base, where a log says where the sensor is on it."""

from collections import Counter
from dataclasses import replace
from shutil import copytree

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from mapper.config.build import BuildConfig
from mapper.core.geometry import exp, inverse
from mapper.core.rotations import rotation_from_quaternion
from mapper.core.trajectory import Trajectory
from mapper.export.exporters import export
from mapper.export.part_of_run import part_of
from mapper.pipeline.build import build
from mapper.pipeline.fuse import fuse
from mapper.run import files
from mapper.run.folder import open_run
from mapper.run.manifest_logs import AppendedLog, RobotFrames
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.trajectory_files import read_tum

T_BASE_BODY = exp(np.array([1.2, -1.2, 1.2]), np.array([0.2, 0.0, 1.1]))


@pytest.fixture(scope="module")
def run(desk_log, tmp_path_factory):
    log = open_source(desk_log, SourceConfig(last_frame=9))
    mounted = replace(log, T_base_body=T_BASE_BODY, base_frame="base_link", body_frame="optical")
    return build(mounted, BuildConfig(), tmp_path_factory.mktemp("run") / "run")


def transforms_of(run, tmp_path):
    """Return all transforms of a run exported to ROS."""
    with AnyReader([export(run, "rosbag2", tmp_path / "bag")]) as reader:
        return [
            one
            for connection, _, data in reader.messages()
            if connection.topic in ("/tf", "/tf_static")
            for one in reader.deserialize(data, connection.msgtype).transforms
        ]


def test_a_run_has_the_poses_of_the_base(run):
    base = read_tum(run.file(files.BASE))
    np.testing.assert_array_equal(base.stamps_ns, run.trajectory.stamps_ns)
    np.testing.assert_allclose(
        base.T_world_body, run.trajectory.T_world_body @ inverse(T_BASE_BODY), atol=1e-12
    )


def test_ros_gets_the_base_in_the_map_and_the_sensor_on_the_base(run, tmp_path):
    found = {}
    for one in transforms_of(run, tmp_path):
        found.setdefault((one.header.frame_id, one.child_frame_id), one.transform)
    assert found.keys() == {("map", "base_link"), ("base_link", "optical"), ("optical", "camera")}
    place = found["base_link", "optical"]
    t, q = place.translation, place.rotation
    np.testing.assert_allclose([t.x, t.y, t.z], T_BASE_BODY[:3, 3], atol=1e-12)
    np.testing.assert_allclose(
        rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w])), T_BASE_BODY[:3, :3], atol=1e-9
    )


@pytest.fixture(scope="module")
def moving_run(desk_log, tmp_path_factory):
    log = open_source(desk_log, SourceConfig(last_frame=9))
    turns = np.array([exp(np.array([0.0, 0.1 * i, 0.0]), np.zeros(3)) for i in range(6)])
    T_body_base = Trajectory(log.stamps_ns[2:8], turns @ inverse(T_BASE_BODY))
    mounted = replace(
        log, T_body_base=T_body_base, base_frame="base_link", body_frame="optical", base_height_m=0.1
    )
    return T_body_base, build(mounted, BuildConfig(), tmp_path_factory.mktemp("run") / "run")


def test_a_base_that_moves_below_the_sensor_has_poses_where_they_are_known(moving_run):
    T_body_base, run = moving_run
    base = read_tum(run.file(files.BASE))
    np.testing.assert_array_equal(base.stamps_ns, T_body_base.stamps_ns)
    expected = run.trajectory.T_world_body[2:8] @ T_body_base.T_world_body
    np.testing.assert_allclose(base.T_world_body, expected, atol=1e-9)
    assert run.manifest.input.robot == RobotFrames(base="base_link", body="optical")


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


def test_ros_gets_such_a_base_on_the_body_at_its_stamps(moving_run, tmp_path):
    T_body_base, run = moving_run
    links = Counter((one.header.frame_id, one.child_frame_id) for one in transforms_of(run, tmp_path))
    assert links == {
        ("map", "optical"): len(run.trajectory),
        ("optical", "base_link"): len(T_body_base),
        ("optical", "camera"): 1,
    }


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
