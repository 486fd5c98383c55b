"""Foxglove's schemas, as protobuf or JSON (https://docs.foxglove.dev/docs/sdk/schemas).

Both become the same dictionaries. The field numbers of the published .proto files never change, so reading
protobuf's wire format takes a loop and a table, and large payloads stay views of the message.
"""

import base64
import json
import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from mapper.core.errors import DataError
from mapper.core.timebase import NS_PER_S
from mapper.sources.ros.cloud_messages import structured
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

_Fields = Mapping[str, Any]

# Of each message: field number to name, and how it is stored; a message's own name is a nested message,
# and a star marks what repeats.
_TABLES: Mapping[str, Mapping[int, tuple[str, str]]] = {
    "time": {1: ("sec", "int"), 2: ("nsec", "int")},
    "foxglove.CompressedImage": {
        1: ("timestamp", "time"),
        2: ("data", "bytes"),
        3: ("format", "text"),
        4: ("frame_id", "text"),
    },
    "foxglove.RawImage": {
        1: ("timestamp", "time"),
        2: ("width", "int"),
        3: ("height", "int"),
        4: ("encoding", "text"),
        5: ("step", "int"),
        6: ("data", "bytes"),
        7: ("frame_id", "text"),
    },
    "foxglove.CameraCalibration": {
        1: ("timestamp", "time"),
        2: ("width", "int"),
        3: ("height", "int"),
        4: ("distortion_model", "text"),
        5: ("D", "doubles"),
        6: ("K", "doubles"),
        8: ("P", "doubles"),
        9: ("frame_id", "text"),
    },
    "foxglove.PointCloud": {
        1: ("timestamp", "time"),
        2: ("frame_id", "text"),
        3: ("pose", "pose"),
        4: ("point_stride", "int"),
        5: ("fields", "field*"),
        6: ("data", "bytes"),
    },
    "field": {1: ("name", "text"), 2: ("offset", "int"), 3: ("type", "int")},
    "foxglove.FrameTransform": {
        1: ("timestamp", "time"),
        2: ("parent_frame_id", "text"),
        3: ("child_frame_id", "text"),
        4: ("translation", "vector"),
        5: ("rotation", "vector"),
    },
    "foxglove.FrameTransforms": {1: ("transforms", "foxglove.FrameTransform*")},
    "foxglove.PoseInFrame": {1: ("timestamp", "time"), 2: ("frame_id", "text"), 3: ("pose", "pose")},
    "pose": {1: ("position", "vector"), 2: ("orientation", "vector")},
    "vector": {1: ("x", "double"), 2: ("y", "double"), 3: ("z", "double"), 4: ("w", "double")},
}
_EMPTY: Mapping[str, Any] = {
    "int": 0,
    "double": 0.0,
    "doubles": np.empty(0),
    "text": "",
    "bytes": memoryview(b""),
}
_NUMERIC_TYPES = ("", "u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8")  # PackedElementField.NumericType
_VARINT, _FIXED_64, _LENGTH, _FIXED_32 = 0, 1, 2, 5


def stamp_of(encoding: str, data: memoryview) -> int:
    """Return a message's timestamp, nanoseconds; every schema with one has it first.

    Raises:
        DataError: The message is damaged, has none, or is neither protobuf nor JSON.
    """
    try:
        if encoding == "protobuf":
            return next((_ns(_parsed("time", value)) for number, value in _wire(data) if number == 1), 0)
        if encoding == "json":
            return _ns(_json(data).get("timestamp", {}))
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise DataError(f"a damaged timestamp: {error}") from None
    raise DataError(f"messages encoded as {encoding!r} are not read; known are cdr, ros1, protobuf and json")


def decode_foxglove(topic: Topic, data: memoryview) -> Message:
    """Return what a message says.

    Raises:
        DataError: The message is damaged, or of a schema that is not read.
    """
    read = _READERS.get(topic.type)
    if read is None:
        raise DataError(f"messages of type {topic.type} are not read")
    return read(_json(data) if topic.encoding == "json" else _parsed(topic.type, data))


def _pixels(m: _Fields) -> PixelsMessage:
    return PixelsMessage(
        stamp_ns=_ns(m["timestamp"]),
        frame=m["frame_id"],
        encoding=m["encoding"],
        width_px=m["width"],
        height_px=m["height"],
        row_bytes=m["step"],
        is_big_endian=False,
        data=_bytes(m["data"]),
    )


def _file(m: _Fields) -> FileMessage:
    return FileMessage(_ns(m["timestamp"]), m["frame_id"], m["format"], _bytes(m["data"]))


def _camera(m: _Fields) -> CameraMessage:
    D, K, P = (np.asarray(m[name], dtype=np.float64) for name in "DKP")
    return CameraMessage(m["frame_id"], m["width"], m["height"], m["distortion_model"], D, K, P)


def _cloud(m: _Fields) -> CloudMessage:
    fields = [(f["name"], f["offset"], "<" + _NUMERIC_TYPES[f["type"]], 1) for f in m["fields"]]
    data = _bytes(m["data"])
    stride = m["point_stride"]
    points = structured(data, fields, point_bytes=stride, shape=(1, len(data) // max(stride, 1)))
    T_frame_points = pose_from_numbers(np.array(_numbers(m["pose"]["position"], m["pose"]["orientation"])))
    if T_frame_points is None:  # protobuf leaves zeros out: an empty pose is none
        T_frame_points = np.eye(4)
    return CloudMessage(_ns(m["timestamp"]), m["frame_id"], points, T_frame_points)


def _transform(m: _Fields) -> list[PoseMessage]:
    numbers = _numbers(m["translation"], m["rotation"])
    return [PoseMessage(_ns(m["timestamp"]), m["parent_frame_id"], m["child_frame_id"], numbers)]


def _transforms(m: _Fields) -> list[PoseMessage]:
    return [pose for transform in m["transforms"] for pose in _transform(transform)]


def _pose_in_frame(m: _Fields) -> list[PoseMessage]:
    numbers = _numbers(m["pose"]["position"], m["pose"]["orientation"])
    return [PoseMessage(_ns(m["timestamp"]), m["frame_id"], "", numbers)]


_READERS: Mapping[str, Callable[[_Fields], Message]] = {
    "foxglove.RawImage": _pixels,
    "foxglove.CompressedImage": _file,
    "foxglove.CameraCalibration": _camera,
    "foxglove.PointCloud": _cloud,
    "foxglove.FrameTransform": _transform,
    "foxglove.FrameTransforms": _transforms,
    "foxglove.PoseInFrame": _pose_in_frame,
}


def _numbers(p: _Fields, q: _Fields) -> tuple[float, ...]:
    return (p["x"], p["y"], p["z"], q["x"], q["y"], q["z"], q["w"])


def _ns(time: _Fields) -> int:
    return int(time["sec"]) * NS_PER_S + int(time["nsec"])


def _bytes(data: memoryview | str) -> memoryview:
    """JSON has no bytes: it spells them in base 64."""
    return memoryview(base64.b64decode(data)) if isinstance(data, str) else data


def _json(data: memoryview) -> _Fields:
    fields = json.loads(bytes(data))
    if not isinstance(fields, dict):
        raise DataError("a JSON message that is no object")
    return fields


def _parsed(kind: str, data: memoryview) -> _Fields:
    """Return a protobuf message's fields by name; absent ones are empty, as protobuf has it."""
    table = _TABLES[kind]
    fields: dict[str, Any] = {}
    for name, stored in table.values():
        if stored.endswith("*"):
            fields[name] = []
        elif stored not in _TABLES:
            fields[name] = _EMPTY[stored]
    for number, value in _wire(data):
        if number not in table:
            continue
        name, stored = table[number]
        if stored.endswith("*"):
            fields[name].append(_parsed(stored[:-1], value))
        elif stored in _TABLES:
            fields[name] = _parsed(stored, value)
        elif stored == "text":
            fields[name] = str(value, "utf-8")
        elif stored == "doubles":
            fields[name] = np.frombuffer(value, "<f8")
        else:
            fields[name] = value
    for name, stored in table.values():
        if stored in _TABLES and name not in fields:
            fields[name] = _parsed(stored, memoryview(b""))
    return fields


def _wire(data: memoryview) -> Iterator[tuple[int, Any]]:
    """Yield number and value of every field: int, float or the bytes of a text, message or packed list.

    The wire format is https://protobuf.dev/programming-guides/encoding.
    """
    at = 0
    try:
        while at < len(data):
            key, at = _varint(data, at)
            number, kind = key >> 3, key & 7
            if kind == _VARINT:
                value, at = _varint(data, at)
                yield number, value
            elif kind == _FIXED_64:
                yield number, struct.unpack_from("<d", data, at)[0]
                at += 8
            elif kind == _FIXED_32:
                yield number, struct.unpack_from("<I", data, at)[0]
                at += 4
            elif kind == _LENGTH:
                length, at = _varint(data, at)
                if at + length > len(data):
                    raise DataError("a protobuf message that ends within a field")
                yield number, data[at : at + length]
                at += length
            else:
                raise DataError(f"a protobuf field of the unknown wire type {kind}")
    except (IndexError, struct.error):
        raise DataError("a protobuf message that ends within a field") from None


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """Return a number of seven bits a byte, the lowest first, and where it ends."""
    value = shift = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
