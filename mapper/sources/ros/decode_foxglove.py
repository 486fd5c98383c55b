"""Foxglove's messages decoded, from protobuf or JSON (https://docs.foxglove.dev/docs/sdk/schemas).

Protobuf is parsed with the schemas of foxglove-sdk and not with those in the file, which may be damaged: the
field numbers of a published schema never change.
"""

import base64
import json
from collections.abc import Callable, Mapping
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from foxglove import messages
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessages
from google.protobuf.timestamp_pb2 import Timestamp

from mapper.core.errors import DataError
from mapper.core.geometry import Transform
from mapper.core.timebase import NS_PER_S
from mapper.sources.laser_scan import laser_records
from mapper.sources.ros.cloud_messages import structured, usable_fields
from mapper.sources.ros.messages import (
    CameraMessage,
    CloudMessage,
    FileMessage,
    Message,
    PixelsMessage,
    PoseMessage,
)
from mapper.sources.ros.recording import Topic
from mapper.sources.text import pose_from_numbers

_NUMERIC_TYPES = dict(enumerate(("u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"), start=1))
"""Numpy's names of PackedElementField.NumericType."""
_TIMESTAMP_TAG = 0x0A
"""The byte before the timestamp of a message: field 1, a nested message. The next is its length."""
_LONGEST_TIMESTAMP = 22  # bytes: seconds and nanoseconds are a tag and at most ten bytes each


def stamp_of(topic: Topic, data: memoryview) -> int:
    """Return a message's timestamp, nanoseconds; 0 where a protobuf message has none.

    Raises:
        DataError: The timestamp is damaged, or the message is neither protobuf nor JSON.
    """
    try:
        if topic.encoding == "protobuf":
            return _ns(_protobuf_timestamp(topic, data))
        if topic.encoding == "json":
            return _ns(_parse_json(data).timestamp)
    except (DecodeError, AttributeError, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(f"a damaged timestamp: {error}") from None
    raise DataError(
        f"messages encoded as {topic.encoding!r} are not read; known are cdr, ros1, protobuf and json"
    )


def decode_foxglove(topic: Topic, data: memoryview) -> Message:
    """Return a decoded message.

    Raises:
        DataError: The message is damaged, or of a schema that is not read.
    """
    read = _READERS.get(topic.type)
    if read is None:
        raise DataError(f"messages of type {topic.type} are not read")
    try:
        return read(_parse_json(data) if topic.encoding == "json" else _parse_protobuf(topic.type, data))
    except (DecodeError, AttributeError) as error:  # the latter for a field that a JSON message lacks
        raise DataError(f"a damaged message: {error}") from None


def _pixels(m: Any) -> PixelsMessage:
    return PixelsMessage(
        stamp_ns=_ns(m.timestamp),
        frame=m.frame_id,
        encoding=m.encoding,
        width_px=m.width,
        height_px=m.height,
        row_bytes=m.step,
        is_big_endian=False,
        data=_payload(m.data),
    )


def _file(m: Any) -> FileMessage:
    return FileMessage(_ns(m.timestamp), m.frame_id, m.format, _payload(m.data))


def _camera(m: Any) -> CameraMessage:
    D, K, P, R = (np.array(numbers, dtype=np.float64) for numbers in (m.D, m.K, m.P, m.R))
    return CameraMessage(m.frame_id, m.width, m.height, m.distortion_model, D, K, P, R=R)


def _cloud(m: Any) -> CloudMessage:
    data, stride = _payload(m.data), m.point_stride
    stated = [(f.name, f.offset, f.type, 1) for f in m.fields]
    fields, notes = usable_fields(stated, _NUMERIC_TYPES, order="<", point_bytes=stride)
    points = structured(data, fields, point_bytes=stride, shape=(1, len(data) // max(stride, 1)))
    return CloudMessage(_ns(m.timestamp), m.frame_id, points, _pose_of(m), notes)


def _laser(m: Any) -> CloudMessage:
    ranges_m = np.asarray(m.ranges, np.float64)
    points = laser_records(
        ranges_m,
        first_rad=m.start_angle,
        step_rad=(m.end_angle - m.start_angle) / max(len(ranges_m) - 1, 1),
        intensities=np.asarray(m.intensities),
    )
    return CloudMessage(_ns(m.timestamp), m.frame_id, points, _pose_of(m))


def _pose_of(m: Any) -> Transform:
    """Return the pose of a message's points in its frame; protobuf leaves zeros out: an empty one is none."""
    T_frame_points = pose_from_numbers(np.array(_numbers(m.pose.position, m.pose.orientation)))
    return np.eye(4) if T_frame_points is None else T_frame_points


def _transform(m: Any) -> list[PoseMessage]:
    numbers = _numbers(m.translation, m.rotation)
    return [PoseMessage(_ns(m.timestamp), m.parent_frame_id, m.child_frame_id, numbers)]


def _transforms(m: Any) -> list[PoseMessage]:
    return [pose for transform in m.transforms for pose in _transform(transform)]


def _pose_in_frame(m: Any) -> list[PoseMessage]:
    numbers = _numbers(m.pose.position, m.pose.orientation)
    return [PoseMessage(_ns(m.timestamp), m.frame_id, "", numbers)]


_READERS: Mapping[str, Callable[[Any], Message]] = {
    "foxglove.RawImage": _pixels,
    "foxglove.CompressedImage": _file,
    "foxglove.CameraCalibration": _camera,
    "foxglove.PointCloud": _cloud,
    "foxglove.LaserScan": _laser,
    "foxglove.FrameTransform": _transform,
    "foxglove.FrameTransforms": _transforms,
    "foxglove.PoseInFrame": _pose_in_frame,
}


def _numbers(p: Any, q: Any) -> tuple[float, ...]:
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)


def _ns(time: Any) -> int:
    """Return a protobuf or a JSON timestamp in nanoseconds."""
    if isinstance(time, SimpleNamespace):
        return int(time.sec) * NS_PER_S + int(time.nsec)
    return int(time.seconds * NS_PER_S + time.nanos)


def _payload(data: bytes | str) -> memoryview:
    """Return bytes, which JSON spells in base 64."""
    return memoryview(base64.b64decode(data) if isinstance(data, str) else data)


def _parse_json(data: memoryview) -> Any:
    message = json.loads(bytes(data), object_hook=lambda fields: SimpleNamespace(**fields))
    if not isinstance(message, SimpleNamespace):
        raise DataError("a JSON message that is no object")
    return message


def _parse_protobuf(type_: str, data: memoryview) -> Any:
    return _message_class(type_).FromString(data)


@cache
def _message_class(type_: str) -> Any:
    if type_ not in _READERS:
        raise DataError(f"messages of type {type_} are not read")
    schema = getattr(messages, type_.removeprefix("foxglove.")).get_schema()
    return GetMessages(FileDescriptorSet.FromString(schema.data).file)[type_]


def _protobuf_timestamp(topic: Topic, data: memoryview) -> Any:
    """Return the timestamp, without parsing the rest where it comes first, as encoders write it.

    So no payload is copied to index a recording, and a message that is cut short keeps its stamp.
    """
    if len(data) < 2 or data[0] >> 3 != 1:
        return _parse_protobuf(topic.type, data).timestamp
    if data[0] != _TIMESTAMP_TAG or data[1] > min(_LONGEST_TIMESTAMP, len(data) - 2):
        raise DataError("a timestamp that is no message or is cut short")
    return Timestamp.FromString(data[2 : 2 + data[1]])
