"""Foxglove's messages, written by its own library and read without."""

import base64
import json

import numpy as np
import pytest
from foxglove import messages
from foxglove.messages import PackedElementFieldNumericType as NumericType

from mapper.core.errors import DataError
from mapper.core.timebase import NS_PER_S
from mapper.sources import open_source
from mapper.sources.ros.decode import decode
from mapper.sources.ros.decode_foxglove import decode_foxglove, stamp_of
from mapper.sources.ros.recording import Topic
from tests.support.recordings import write_foxglove
from tests.support.tum_logs import FIRST_NS, picture

STAMP = messages.Timestamp(sec=FIRST_NS // NS_PER_S, nsec=FIRST_NS % NS_PER_S)
JSON_STAMP = {"sec": FIRST_NS // NS_PER_S, "nsec": FIRST_NS % NS_PER_S}
RGB, UNITS = picture(2)
K = [60.0, 0.0, 31.5, 0.0, 61.0, 23.5, 0.0, 0.0, 1.0]
D = [0.1, -0.2, 0.001, 0.002, 0.05]
POSITION = messages.Vector3(x=1.0, y=-2.0, z=3.5)
ORIENTATION = messages.Quaternion(x=0.0, y=0.0, z=0.6, w=0.8)
POSE = messages.Pose(position=POSITION, orientation=ORIENTATION)
RAW_IMAGE = Topic("/t", "foxglove.RawImage", "protobuf")
NUMBERS = (1.0, -2.0, 3.5, 0.0, 0.0, 0.6, 0.8)


def raw_image(pixels, encoding):
    return messages.RawImage(
        timestamp=STAMP, frame_id="optical", width=64, height=48, encoding=encoding,
        step=pixels.nbytes // 48, data=pixels.tobytes(),
    )  # fmt: skip


def calibration():
    return messages.CameraCalibration(
        timestamp=STAMP, frame_id="optical", width=64, height=48, distortion_model="plumb_bob",
        D=D, K=K, R=np.eye(3).ravel().tolist(), P=[60.0, 0, 31.5, 0, 0, 61.0, 23.5, 0, 0, 0, 1, 0],
    )  # fmt: skip


def cloud(points):
    layout = [("x", 0), ("y", 4), ("z", 8)]
    return messages.PointCloud(
        timestamp=STAMP, frame_id="lidar", pose=POSE, point_stride=12, data=points.tobytes(),
        fields=[messages.PackedElementField(name=n, offset=o, type=NumericType.Float32) for n, o in layout],
    )  # fmt: skip


def read(type_, data, encoding="protobuf"):
    return decode(Topic("/t", type_, encoding), memoryview(data))


def test_images():
    message = read("foxglove.RawImage", raw_image(RGB, "rgb8").encode())
    assert (message.stamp_ns, message.frame, message.encoding) == (FIRST_NS, "optical", "rgb8")
    assert (message.width_px, message.height_px, message.row_bytes) == (64, 48, 192)
    assert bytes(message.data) == RGB.tobytes()
    packed = messages.CompressedImage(
        timestamp=STAMP, frame_id="optical", data=b"\xff\xd8file", format="jpeg"
    )
    message = read("foxglove.CompressedImage", packed.encode())
    assert (message.stamp_ns, message.frame, message.format) == (FIRST_NS, "optical", "jpeg")
    assert bytes(message.data) == b"\xff\xd8file"


def test_calibration():
    message = read("foxglove.CameraCalibration", calibration().encode())
    assert (message.width_px, message.height_px, message.model) == (64, 48, "plumb_bob")
    assert (message.K.tolist(), message.D.tolist()) == (K, D)
    assert message.P[6] == 23.5


def test_clouds_have_a_pose():
    points = np.arange(30, dtype=np.float32).reshape(10, 3)
    message = read("foxglove.PointCloud", cloud(points).encode())
    assert (message.stamp_ns, message.frame) == (FIRST_NS, "lidar")
    np.testing.assert_array_equal(message.points["y"], points[:, 1])
    np.testing.assert_array_equal(message.T_frame_points[:3, 3], NUMBERS[:3])


def test_poses_and_transforms():
    (pose,) = read(
        "foxglove.PoseInFrame", messages.PoseInFrame(timestamp=STAMP, frame_id="world", pose=POSE).encode()
    )
    assert (pose.stamp_ns, pose.parent, pose.child, pose.numbers) == (FIRST_NS, "world", "", NUMBERS)
    transform = messages.FrameTransform(
        timestamp=STAMP, parent_frame_id="world", child_frame_id="body",
        translation=POSITION, rotation=ORIENTATION,
    )  # fmt: skip
    (alone,) = read("foxglove.FrameTransform", transform.encode())
    together = read(
        "foxglove.FrameTransforms", messages.FrameTransforms(transforms=[transform, transform]).encode()
    )
    assert (alone.parent, alone.child, alone.numbers) == ("world", "body", NUMBERS)
    assert [t.numbers for t in together] == [NUMBERS, NUMBERS]


def test_a_field_of_an_unknown_type_is_left_out_and_named():
    points = np.arange(12, dtype=np.float32).reshape(4, 3)
    for type_ in (0, 99):
        fields = [{"name": name, "offset": 4 * i, "type": 7} for i, name in enumerate("xyz")]
        message = {
            "timestamp": JSON_STAMP, "frame_id": "lidar", "point_stride": 12,
            "pose": {"position": dict.fromkeys("xyz", 0.0), "orientation": dict.fromkeys("xyzw", 0.0)},
            "fields": [*fields, {"name": "intensity", "offset": 8, "type": type_}],
            "data": base64.b64encode(points.tobytes()).decode(),
        }  # fmt: skip
        found = read("foxglove.PointCloud", json.dumps(message).encode(), "json")
        assert found.points.dtype.names == ("x", "y", "z")
        assert sum("intensity" in note for note in found.notes) == 1


def test_json_says_the_same():
    fields = {
        "timestamp": JSON_STAMP, "frame_id": "optical", "width": 64, "height": 48, "encoding": "rgb8",
        "step": 192, "data": base64.b64encode(RGB.tobytes()).decode(),
    }  # fmt: skip
    data = json.dumps(fields).encode()
    assert stamp_of(Topic("/t", "foxglove.RawImage", "json"), memoryview(data)) == FIRST_NS
    told, expected = (
        read("foxglove.RawImage", data, "json"),
        read("foxglove.RawImage", raw_image(RGB, "rgb8").encode()),
    )
    assert bytes(told.data) == bytes(expected.data)
    assert (told.stamp_ns, told.frame, told.row_bytes) == (
        expected.stamp_ns,
        expected.frame,
        expected.row_bytes,
    )


def test_a_stamp_is_read_without_the_rest_and_may_come_late_or_not_at_all():
    data = raw_image(RGB, "rgb8").encode()
    end = 2 + data[1]  # of the first field, the timestamp
    for part, stamp_ns in (
        (data, FIRST_NS),
        (data[:16], FIRST_NS),
        (data[end:] + data[:end], FIRST_NS),
        (data[end:], 0),
    ):
        assert stamp_of(RAW_IMAGE, memoryview(part)) == stamp_ns


@pytest.mark.parametrize(
    ("type_", "message"),
    [
        ("foxglove.PointCloud", cloud(np.arange(30, dtype=np.float32))),
        ("foxglove.CameraCalibration", calibration()),
        ("foxglove.PoseInFrame", messages.PoseInFrame(timestamp=STAMP, frame_id="world", pose=POSE)),
    ],
)
def test_damage_is_found_or_leaves_a_message(type_, message):
    rng, whole = np.random.default_rng(0), message.encode()
    topic, damaged = Topic("/t", type_, "protobuf"), 0
    for _ in range(300):
        data = bytearray(whole)
        data[rng.integers(len(data))] = rng.integers(256)
        data = memoryview(bytes(data[: rng.integers(len(data) // 2, len(data) + 1)]))
        for read_part in (decode, stamp_of):
            try:
                read_part(topic, data)
            except DataError:
                damaged += 1
    assert 200 < damaged < 500


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        *(("protobuf", raw_image(RGB, "rgb8").encode()[:-cut]) for cut in (1, 5, 20, 200)),
        *(("json", data) for data in (b"[]", b"{", b"{}", b'{"timestamp": 3}', 100_000 * b'{"a":')),
    ],
)
def test_a_message_cut_short_or_of_another_shape_is_an_error(encoding, data):
    with pytest.raises(DataError, match=r"a damaged message|no object"):
        read("foxglove.RawImage", data, encoding)


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("protobuf", b"\x08\x05"),  # a number where the time belongs
        ("protobuf", b"\x0a\xff"),
        ("json", b"{"),
        ("json", b'{"timestamp": null}'),
        ("json", b'{"timestamp": {"sec": "x", "nsec": 0}}'),
        ("json", b'{"timestamp": {"sec": 1e999, "nsec": 0}}'),
        ("json", b'{"timestamp": ' + 100_000 * b"["),
    ],
)
def test_a_damaged_stamp_is_an_error(encoding, data):
    with pytest.raises(DataError):
        stamp_of(Topic("/t", "foxglove.RawImage", encoding), memoryview(data))


def test_what_is_not_read_is_named():
    with pytest.raises(DataError, match=r"messages of type foxglove.Log are not read"):
        decode_foxglove(Topic("/log", "foxglove.Log", "protobuf"), memoryview(b""))
    with pytest.raises(DataError, match="encoded as 'flatbuffer' are not read"):
        stamp_of(Topic("/t", "foxglove.RawImage", "flatbuffer"), memoryview(b""))


def test_a_foxglove_recording_is_a_log(tmp_path):
    messages = {"/depth": raw_image(UNITS, "16UC1"), "/color": raw_image(RGB, "rgb8"), "/info": calibration()}
    recorded = [(topic, 7, message) for topic, message in messages.items()]
    (entry,) = open_source(write_foxglove(tmp_path / "log.mcap", recorded)).entries()
    frame = entry.load()
    assert frame.stamp_ns == FIRST_NS
    assert (frame.camera.fx_px, frame.camera.distortion) == (60.0, tuple(D))
    np.testing.assert_array_equal(frame.image, RGB)
    np.testing.assert_array_equal(frame.depth_m, UNITS.astype(np.float32) / np.float32(1000))
