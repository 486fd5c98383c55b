"""Recordings made message by message, for the tests of reading them."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mapper.core.frames import PinholeCamera
from mapper.core.geometry import Transform
from mapper.sources.ros.encode_ros import (
    SerializedMessage,
    camera_info_message,
    image_message,
    transforms_message,
)
from mapper.sources.ros.message_writers import write_recording_file
from mapper.sources.ros.typestore import serialize, typestore
from tests.support.tum_logs import FIRST_NS, PERIOD_NS, picture

CAMERA = PinholeCamera(64, 48, 60.0, 61.0, 31.5, 23.5, (0.1, -0.2, 0.001, 0.002, 0.05))
COLOR, DEPTH = "/cam/color/image_raw", "/cam/aligned_depth/image_raw"


def image(
    stamp_ns: int, topic: str, pixels: np.ndarray, encoding: str, *, frame: str = "optical"
) -> SerializedMessage:
    return image_message(stamp_ns, topic, pixels, encoding=encoding, frame=frame)


def camera_info(
    stamp_ns: int, topic: str = "/cam/color/camera_info", camera: PinholeCamera = CAMERA
) -> SerializedMessage:
    return camera_info_message(stamp_ns, topic, camera, frame="optical")


def shots(n: int = 6, *, first_ns: int = FIRST_NS) -> list[SerializedMessage]:
    """RGB-D messages whose depth, in millimetres, comes 5 ms before the colour."""
    messages = []
    for i in range(n):
        stamp_ns = first_ns + i * PERIOD_NS
        rgb, units = picture(i)
        messages += [
            image(stamp_ns - 5_000_000, DEPTH, units, "16UC1"),
            image(stamp_ns, COLOR, rgb, "rgb8"),
            camera_info(stamp_ns),
        ]
    return messages


def transforms(
    *told: tuple[str, str, Transform], topic: str = "/tf_static", stamp_ns: int = 0
) -> SerializedMessage:
    """A message of tf of (parent, child, T_parent_child)."""
    return transforms_message(stamp_ns, topic, told)._replace(stamp_ns=stamp_ns or FIRST_NS)


def write(path: Path, messages: Iterable[SerializedMessage]) -> Path:
    """Write messages in the order given, into whatever the path is named as."""
    if path.suffix in (".mcap", ".bag"):
        write_recording_file(path, messages, kind=path.suffix[1:])
    else:
        write_folder(Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3), messages)
    return path


def changed(message: SerializedMessage, **fields: object) -> SerializedMessage:
    """The same message but for some fields."""
    store = typestore("cdr")
    made = replace(store.deserialize_cdr(message.cdr, message.type), **fields)
    return message._replace(cdr=serialize(made))


def write_foxglove(path: Path, messages: Iterable[tuple[str, int, Any]]) -> Path:
    """Write (topic, time in nanoseconds, message) of Foxglove's own library as protobuf in an MCAP file."""
    channels: dict[str, int] = {}
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        for topic, log_ns, message in messages:
            if topic not in channels:
                schema = message.get_schema()
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[topic] = writer.register_channel(topic, "protobuf", number)
            writer.add_message(channels[topic], log_ns, message.encode(), log_ns)
        writer.finish()
    return path


def add_messages(writer: McapWriter, messages: Iterable[SerializedMessage]) -> None:
    """Add messages to an MCAP file of other options than ours, with a channel for each topic."""
    channels: dict[str, int] = {}
    for message in messages:
        if message.topic not in channels:
            schema = writer.register_schema(message.type, "ros2msg", b"")
            channels[message.topic] = writer.register_channel(message.topic, "cdr", schema)
        writer.add_message(channels[message.topic], message.stamp_ns, message.cdr, message.stamp_ns)


def write_folder(folder: Writer, messages: Iterable[SerializedMessage]) -> None:
    """Write messages as ROS 2 records them, a nanosecond apart."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    extrinsics = "float64[9] rotation\nfloat64[3] translation\n"
    store.register(get_types_from_msg(extrinsics, "realsense2_camera_msgs/msg/Extrinsics"))
    connections = {}
    with folder as writer:
        for log_ns, message in enumerate(messages, start=FIRST_NS):
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.type, typestore=store
                )
            writer.write(connections[message.topic], log_ns, message.cdr)
