import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mapper.core.errors import DataError
from mapper.core.frames import PinholeCamera
from mapper.core.geometry import exp, inverse
from mapper.core.rotations import rotation_from_quaternion
from mapper.core.trajectory import Trajectory
from mapper.export.mcap_log import McapLog
from mapper.export.mcap_messages import sample_segments
from mapper.graph.model import BetweenFactor, PoseSigmas
from mapper.mapping.thumbnails import encode_jpeg, shrunk_camera
from mapper.octree.grid import OccupancyGrid

FIRST_NS = 1305031102175304001  # not a multiple of what float seconds can hold
PERIOD_NS = 33_333_337
FRAMES = 30
CAMERA = PinholeCamera(640, 480, 525.0, 520.0, 319.5, 239.5, (0.26, -0.95, -0.005, 0.003, 1.16))
RERUN = Path(sys.executable).with_name("rerun")


def trajectory_of(n):
    stamps_ns = FIRST_NS + PERIOD_NS * np.arange(n, dtype=np.int64)
    poses = [exp(np.array([0.0, 0.02 * i, 0.1 * i]), np.array([0.05 * i, 0.0, 1.0])) for i in range(n)]
    return Trajectory(stamps_ns, np.array(poses))


def factors_of(trajectory):
    poses, information = trajectory.T_world_body, PoseSigmas(0.01, 0.01).information

    def factor(i, j, origin):
        return BetweenFactor(i, j, inverse(poses[i]) @ poses[j], information, origin)

    steps = [factor(i, i + 1, "odometry") for i in range(len(poses) - 1)]
    return [*steps, factor(0, len(poses) - 1, "loop")]


def record_of(i):
    return {"features": 1000 + i, "residual": 0.25 * i, "method": "map" if i else "first"}


COVARIANCE = np.diag([1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.03])  # about and along x, y, z of the body
COVARIANCE[0, 5] = COVARIANCE[5, 0] = 1e-3
GRID = OccupancyGrid(np.array([[-1, 0, 100], [0, 0, -1]], np.int8), np.array([-1.5, 2.25]), resolution_m=0.05)


T_CAMERA_LIDAR = exp(np.array([0.3, -0.2, 0.1]), np.array([0.1, 0.2, 0.3]))


def write_run(path):
    trajectory = trajectory_of(FRAMES)
    noise = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    image = cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC)
    points = np.random.default_rng(1).normal(size=(500, 3)).astype(np.float32)
    colors = np.random.default_rng(2).integers(0, 256, (500, 3), dtype=np.uint8)
    with McapLog(path) as log:
        for i, (stamp, T) in enumerate(zip(trajectory.stamps_ns, trajectory.T_world_body, strict=True)):
            stamp_ns = int(stamp)
            log.transform(stamp_ns, T, parent="map", child="camera")
            log.image(stamp_ns, encode_jpeg(image, width_px=320), frame="camera")
            log.calibration(stamp_ns, shrunk_camera(CAMERA, width_px=320), frame="camera")
            log.diagnostics(stamp_ns, record_of(i))
            log.pose(stamp_ns, T, COVARIANCE)
        log.static_transforms(FIRST_NS, [("camera", "lidar", T_CAMERA_LIDAR), ("camera", "imu", np.eye(4))])
        log.trajectory(FIRST_NS, trajectory, name="estimate")
        log.factors(FIRST_NS, factors_of(trajectory), T_world_node=dict(enumerate(trajectory.T_world_body)))
        log.cloud(FIRST_NS, points, colors=colors, name="octree")
        log.grid(FIRST_NS, GRID)
    return trajectory, points, colors


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    return path, *write_run(path)


def messages_on(path, topic):
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [(m.log_time, decoded) for _, _, m, decoded in reader.iter_decoded_messages(topics=[topic])]


def raw_on(path, topic):
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        return [(schema, message) for schema, _, message in reader.iter_messages(topics=[topic])]


def matrix_of(translation, rotation):
    T = np.eye(4)
    T[:3, :3] = rotation_from_quaternion(np.array([rotation.x, rotation.y, rotation.z, rotation.w]))
    T[:3, 3] = translation.x, translation.y, translation.z
    return T


def test_the_file_is_whole_indexed_and_counted(run):
    path, trajectory, *_ = run
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        messages = [(channel.topic, m) for _, channel, m in reader.iter_messages()]
    statistics = summary.statistics
    counts = {summary.channels[i].topic: n for i, n in statistics.channel_message_counts.items()}
    every_frame = ["/tf", "/camera/image", "/camera/calibration", "/diagnostics", "/pose"]
    assert {topic: n for topic, n in counts.items() if n > 1} == dict.fromkeys(every_frame, FRAMES)
    assert statistics.message_count == len(messages) == sum(counts.values())
    assert (statistics.message_start_time, statistics.message_end_time) == (
        FIRST_NS,
        int(trajectory.stamps_ns[-1]),
    )
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    assert all(m.log_time == m.publish_time for _, m in messages)
    tf_ns = [m.log_time for topic, m in messages if topic == "/tf"]
    np.testing.assert_array_equal(tf_ns, trajectory.stamps_ns)


def test_transforms_carry_the_poses_and_the_exact_stamps(run):
    path, trajectory, *_ = run
    for (log_ns, message), stamp_ns, T in zip(
        messages_on(path, "/tf"), trajectory.stamps_ns, trajectory.T_world_body, strict=True
    ):
        assert log_ns == message.timestamp.seconds * 10**9 + message.timestamp.nanos == stamp_ns
        assert (message.parent_frame_id, message.child_frame_id) == ("map", "camera")
        np.testing.assert_allclose(matrix_of(message.translation, message.rotation), T, atol=1e-12)


def test_transforms_that_stay_are_one_message(run):
    path, *_ = run
    [(log_ns, message)] = messages_on(path, "/tf_static")
    assert log_ns == FIRST_NS
    told = {(one.parent_frame_id, one.child_frame_id): one for one in message.transforms}
    assert told.keys() == {("camera", "lidar"), ("camera", "imu")}
    lidar = told["camera", "lidar"]
    np.testing.assert_allclose(matrix_of(lidar.translation, lidar.rotation), T_CAMERA_LIDAR, atol=1e-12)


def test_trajectory_holds_every_pose_and_a_gapless_dotted_path(run):
    path, trajectory, *_ = run
    [(_, message)] = messages_on(path, "/trajectory/estimate")
    poses = [matrix_of(pose.position, pose.orientation) for pose in message.poses]
    np.testing.assert_allclose(poses, trajectory.T_world_body, atol=1e-12)

    [(_, dots)] = messages_on(path, "/trajectory/estimate/dots")
    positions = np.frombuffer(dots.data, "<f4").reshape(-1, 4)[:, :3]
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() <= 0.0101
    np.testing.assert_allclose(positions[-1], trajectory.positions_world[-1], atol=1e-6)


def test_factors_are_lines_between_their_nodes(run):
    path, trajectory, *_ = run
    [(_, message)] = messages_on(path, "/graph/factors")
    lines = {entity.id: entity.lines[0].points for entity in message.entities}
    assert {name: len(points) for name, points in lines.items()} == {
        "odometry": 2 * (FRAMES - 1),
        "loop": 2,
    }
    ends = np.array([[p.x, p.y, p.z] for p in lines["loop"]])
    np.testing.assert_allclose(ends, trajectory.positions_world[[0, -1]])


def test_images_and_their_camera_agree(run):
    path, *_ = run
    image = messages_on(path, "/camera/image")[0][1]
    camera = messages_on(path, "/camera/calibration")[0][1]
    decoded = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape == (camera.height, camera.width, 3) == (240, 320, 3)
    assert image.format == "jpeg"
    np.testing.assert_allclose(list(camera.K), [262.5, 0, 159.5, 0, 260, 119.5, 0, 0, 1])
    assert tuple(camera.D) == CAMERA.distortion


def test_cloud_keeps_positions_and_colours(run):
    path, _, points, colors = run
    [(_, message)] = messages_on(path, "/map/octree")
    assert [field.name for field in message.fields] == ["x", "y", "z", "red", "green", "blue", "alpha"]
    assert message.point_stride == 16
    got = np.frombuffer(message.data, [("xyz", "<f4", 3), ("rgba", "u1", 4)])
    np.testing.assert_array_equal(got["xyz"], points)
    np.testing.assert_array_equal(got["rgba"][:, :3], colors)


def test_ros_messages_are_what_a_ros_library_reads(run):
    path, trajectory, *_ = run
    store = get_typestore(Stores.ROS2_HUMBLE)
    [(schema, message)] = raw_on(path, "/map/slice")
    grid = store.deserialize_cdr(message.data, schema.name)
    assert grid.header.frame_id == "map"
    assert grid.header.stamp.sec * 10**9 + grid.header.stamp.nanosec == FIRST_NS
    assert (grid.info.width, grid.info.height) == (3, 2)
    assert grid.info.resolution == np.float32(0.05)
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == (-1.5, 2.25)
    np.testing.assert_array_equal(grid.data.reshape(2, 3), GRID.cells)
    assert store.serialize_cdr(grid, schema.name) == message.data

    for (schema, message), T in zip(raw_on(path, "/pose"), trajectory.T_world_body, strict=True):
        stamped = store.deserialize_cdr(message.data, schema.name)
        assert stamped.header.frame_id == "map"
        assert stamped.pose.pose.position.x == T[0, 3]
        covariance = stamped.pose.covariance.reshape(6, 6)  # (x, y, z, about x, y, z) of the world
        R = T[:3, :3]
        np.testing.assert_allclose(covariance[:3, :3], R @ COVARIANCE[3:, 3:] @ R.T, atol=1e-15)
        np.testing.assert_allclose(covariance[3:, 3:], R @ COVARIANCE[:3, :3] @ R.T, atol=1e-15)
        np.testing.assert_allclose(covariance[:3, 3:], R @ COVARIANCE[3:, :3] @ R.T, atol=1e-15)

    records = raw_on(path, "/diagnostics")
    schema = records[0][0]
    store.register(get_types_from_msg(schema.data.decode(), schema.name))
    for i, (_, message) in enumerate(records):
        got = store.deserialize_cdr(message.data, schema.name)
        assert {name: getattr(got, name) for name in record_of(i)} == record_of(i)


def test_a_broken_off_run_leaves_no_file(tmp_path):
    def break_off():
        with McapLog(tmp_path / "run.mcap") as log:
            log.transform(FIRST_NS, np.eye(4), parent="map", child="camera")
            raise RuntimeError("interrupted")

    with pytest.raises(RuntimeError, match="interrupted"):
        break_off()
    assert list(tmp_path.iterdir()) == []


def test_empty_products_are_valid(tmp_path):
    path = tmp_path / "run.mcap"
    with McapLog(path) as log:
        log.trajectory(FIRST_NS, trajectory_of(1), name="estimate")
        log.factors(FIRST_NS, [], T_world_node={})
        log.cloud(FIRST_NS, np.empty((0, 3), np.float32), colors=np.empty((0, 3), np.uint8), name="octree")
    assert len(messages_on(path, "/map/octree")) == len(messages_on(path, "/graph/factors/dots")) == 1


@pytest.mark.parametrize("stamp_ns", [-1, 2**31 * 10**9])
def test_refuses_stamps_that_the_messages_cannot_hold(tmp_path, stamp_ns):
    with McapLog(tmp_path / "run.mcap") as log:
        with pytest.raises(DataError, match="shift the log"):
            log.transform(stamp_ns, np.eye(4), parent="map", child="camera")
        with pytest.raises(DataError, match="shift the log"):
            log.diagnostics(stamp_ns, record_of(0))


def test_refuses_diagnostics_that_change_shape(tmp_path):
    with McapLog(tmp_path / "run.mcap") as log:
        log.diagnostics(FIRST_NS, record_of(0))
        with pytest.raises(DataError, match="want those of the first record"):
            log.diagnostics(FIRST_NS, {"features": 3})
        with pytest.raises(DataError, match="features is a int64"):
            log.diagnostics(FIRST_NS, {**record_of(0), "features": np.int64(3)})


def test_dots_thin_out_before_there_are_too_many():
    starts, ends = np.zeros((3, 3)), np.diag([1000.0, 2000.0, 0.0])
    points = sample_segments(starts, ends)
    assert 90_000 < len(points) <= 100_010
    assert points.max() == 2000.0


def test_a_shrunk_camera_sees_a_point_where_the_shrunk_image_shows_it():
    image = np.zeros((480, 640), np.uint8)
    image[198:203, 398:403] = 255  # centred on pixel (400, 200)
    small = cv2.imdecode(np.frombuffer(encode_jpeg(image, width_px=160), np.uint8), -1)
    weights = np.where(small > 20, small, 0).astype(np.float64)  # without JPEG's ringing
    seen = [(weights.sum(axis=0) @ np.arange(160)), (weights.sum(axis=1) @ np.arange(120))] / weights.sum()

    ray = np.array([[(400 - CAMERA.cx_px) / CAMERA.fx_px, (200 - CAMERA.cy_px) / CAMERA.fy_px, 1.0]])
    [expected] = shrunk_camera(CAMERA, width_px=160).project(ray)

    np.testing.assert_allclose(seen, expected, atol=0.05)


def test_narrow_images_keep_their_size():
    assert shrunk_camera(CAMERA, width_px=640) == CAMERA
    gray = cv2.imdecode(
        np.frombuffer(encode_jpeg(np.full((40, 60), 90, np.uint8), width_px=320), np.uint8), -1
    )
    assert gray.shape == (40, 60)


@pytest.mark.skipif(not RERUN.exists(), reason="rerun-sdk is not installed")
def test_rerun_imports_every_topic_as_something_it_draws(run, tmp_path):
    path, *_ = run
    recording = tmp_path / "run.rrd"
    environment = {**os.environ, "HOME": str(tmp_path)}  # Rerun keeps its settings there

    def rerun(*arguments):
        return subprocess.run(
            [str(RERUN), *arguments],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout

    rerun("mcap", "convert", str(path), "-o", str(recording))
    printed = rerun("rrd", "print", "-v", str(recording))

    for entity, component in {
        "/tf": "Transform3D:translation",
        "/tf_static": "Transform3D:child_frame",
        "/camera/image": "EncodedImage:blob",
        "/camera/calibration": "Pinhole:image_from_camera",
        "/trajectory/estimate": "InstancePoses3D:translations",
        "/trajectory/estimate/dots": "Points3D:positions",
        "/graph/factors/dots": "Points3D:colors",
        "/map/octree": "Points3D:positions",
        "/map/slice": "GridMap:cell_size",
        "/diagnostics": "mapper.msg.Diagnostics:message",
    }.items():
        assert f"{entity}@{component}" in printed
