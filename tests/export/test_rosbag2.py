"""The bag is read by rosbags, with the definitions in it, and its octree by a reader of OctoMap's format."""

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability

from mapper.core.rotations import quaternion_from_rotation
from mapper.export.exporters import export
from mapper.export.run_maps import snapshots_of
from mapper.octree.map import read_octree

TYPES = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/path": "nav_msgs/msg/Path",
    "/ground_truth": "nav_msgs/msg/Path",
    "/map": "nav_msgs/msg/OccupancyGrid",
    "/traversable": "nav_msgs/msg/OccupancyGrid",
    "/cloud": "sensor_msgs/msg/PointCloud2",
    "/dynamic": "sensor_msgs/msg/PointCloud2",
    "/octomap_binary": "octomap_msgs/msg/Octomap",
    "/camera/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
}
PLAYED = {"/tf", "/camera/image_raw/compressed", "/camera/camera_info"}
"""Topics that are published once for those who listen; all others are latched."""


@pytest.fixture(scope="module")
def folder(desk_run, tmp_path_factory):
    return export(desk_run, "rosbag2", tmp_path_factory.mktemp("bag") / "results")


@pytest.fixture(scope="module")
def bag(folder):
    """Every message of the bag by topic, decoded, with its time."""
    with AnyReader([folder]) as reader:
        found = {topic: [] for topic in reader.topics}
        for connection, log_ns, data in reader.messages():
            found[connection.topic].append((log_ns, reader.deserialize(data, connection.msgtype)))
    return found


def only(messages):
    ((_, message),) = messages
    return message


def ns(stamp):
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def vector(point):
    return [point.x, point.y, point.z]


def quaternion(q):
    return np.array([q.x, q.y, q.z, q.w])


def nodes_of_bt(data):
    """Yield the codes, depths and states (1 free, 2 occupied) of the leaves of OctoMap's binary stream.

    A word for each inner node in preorder, two bits a child: 0 unknown, 1 free, 2 occupied, 3 inner.
    """
    words = iter(np.frombuffer(data, "<u2").tolist())

    def visit(code, depth):
        word = next(words)
        states = [word >> 2 * child & 3 for child in range(8)]
        for child, state in enumerate(states):
            if state == 3:
                yield from visit(code << 3 | child, depth + 1)
            elif state:
                yield code << 3 | child, depth + 1, state

    yield from visit(0, 0)
    assert next(words, None) is None


def voxels_of_bt(data):
    """Return {Morton code of a voxel: whether it is occupied}, pruned leaves expanded."""
    found = {}
    for code, depth, state in nodes_of_bt(data):
        size = 8 ** (16 - depth)
        found.update(dict.fromkeys(range(code * size, (code + 1) * size), state == 2))
    return found


def test_every_topic_has_its_type_definition_and_quality(folder, bag):
    with AnyReader([folder]) as reader:
        assert {topic: info.msgtype for topic, info in reader.topics.items()} == TYPES
        for connection in reader.connections:
            (quality,) = connection.ext.offered_qos_profiles
            is_latched = quality.durability == QosDurability.TRANSIENT_LOCAL
            assert is_latched == (connection.topic not in PLAYED)
            assert connection.ext.serialization_format == "cdr"
            assert connection.digest.startswith("RIHS01_")
    assert all(len(bag[topic]) == 1 for topic in TYPES.keys() - PLAYED)


def test_the_metadata_is_what_humble_reads_too(folder, bag):
    yaml = pytest.importorskip("yaml")
    info = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert (info["version"], info["storage_identifier"]) == (8, "mcap")
    assert info["relative_file_paths"] == ["results.mcap"]
    assert info["message_count"] == sum(map(len, bag.values()))
    profiles = {
        each["topic_metadata"]["name"]: each["topic_metadata"]["offered_qos_profiles"]
        for each in info["topics_with_message_count"]
    }
    assert all(isinstance(text, str) for text in profiles.values())  # yaml-cpp of Humble takes no list
    assert yaml.safe_load(profiles["/map"])[0]["durability"] == 1
    assert {path.name for path in folder.iterdir()} == {"manifest.json", "metadata.yaml", "results.mcap"}


def test_poses_are_those_of_the_run(desk_run, bag):
    trajectory = desk_run.trajectory
    sent = [(log_ns, message.transforms[0]) for log_ns, message in bag["/tf"]]
    assert [log_ns for log_ns, _ in sent] == trajectory.stamps_ns.tolist()
    for (log_ns, tf), T in zip(sent, trajectory, strict=True):
        assert (ns(tf.header.stamp), tf.header.frame_id, tf.child_frame_id) == (log_ns, "map", "body")
        np.testing.assert_array_equal(vector(tf.transform.translation), T[:3, 3])
        np.testing.assert_array_equal(quaternion(tf.transform.rotation), quaternion_from_rotation(T[:3, :3]))
    path = only(bag["/path"])
    assert [ns(pose.header.stamp) for pose in path.poses] == trajectory.stamps_ns.tolist()
    positions = [vector(pose.pose.position) for pose in path.poses]
    np.testing.assert_array_equal(positions, trajectory.positions_world)
    truth = only(bag["/ground_truth"])
    true_positions = [vector(pose.pose.position) for pose in truth.poses]
    np.testing.assert_allclose(true_positions, desk_run.results.truth.positions_world)


@pytest.mark.parametrize(("topic", "name"), [("/map", "slice"), ("/traversable", "traversable")])
def test_grids_are_those_of_the_run(desk_run, bag, topic, name):
    ours, theirs = getattr(desk_run, name), only(bag[topic])
    assert theirs.header.frame_id == "map"
    assert (theirs.info.height, theirs.info.width) == ours.cells.shape
    assert theirs.info.resolution == np.float32(ours.resolution_m)
    np.testing.assert_array_equal(theirs.data.reshape(ours.cells.shape), ours.cells)
    np.testing.assert_array_equal(vector(theirs.info.origin.position)[:2], ours.origin_world_m)


def test_the_cloud_has_its_colours(desk_run, bag):
    cloud, ours = only(bag["/cloud"]), desk_run.cloud
    assert [(field.name, field.offset, field.datatype) for field in cloud.fields] == [
        *(("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("rgb", 12, 6)),
    ]
    points = np.frombuffer(cloud.data, np.dtype([("xyz", "<f4", 3), ("bgr0", "u1", 4)]))
    assert (cloud.width, cloud.height, cloud.row_step) == (len(ours), 1, cloud.data.size)
    np.testing.assert_array_equal(points["xyz"], ours.points)
    np.testing.assert_array_equal(points["bgr0"][:, 2::-1], ours.colors)


def test_the_octomap_is_the_run_s_octree(desk_run, bag):
    message = only(bag["/octomap_binary"])
    assert (message.binary, message.id, message.resolution) == (True, "OcTree", 0.05)
    octree = read_octree(desk_run.path / "map.octree")
    leaves = octree.leaves()
    bits = np.arange(16)
    codes = sum(
        ((leaves.keys[:, axis, None].astype(np.int64) >> bits & 1) << 3 * bits + axis).sum(axis=1)
        for axis in range(3)
    )
    ours = dict(zip(codes.tolist(), leaves.log_odds >= octree.occupied_log_odds, strict=True))
    assert voxels_of_bt(message.data.tobytes()) == ours
    assert len(ours) > 10_000


def test_images_are_those_of_the_run_with_their_camera(desk_run, bag):
    images, cameras = bag["/camera/image_raw/compressed"], bag["/camera/camera_info"]
    for (log_ns, image), (_, info), ours in zip(images, cameras, snapshots_of(desk_run), strict=True):
        assert ns(image.header.stamp) == ns(info.header.stamp) == log_ns == ours.stamp_ns
        assert (image.format, image.header.frame_id, info.header.frame_id) == ("jpeg", "body", "body")
        assert image.data.tobytes() == ours.jpeg
        assert cv2.imdecode(image.data, cv2.IMREAD_COLOR).shape[:2] == (info.height, info.width)
        np.testing.assert_array_equal(info.k.reshape(3, 3), ours.camera.matrix)
