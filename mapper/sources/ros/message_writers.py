"""Recordings written one message at a time: MCAP files (ROS 2), ROS 1 bags and ROS 2 bags."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, Protocol

from mcap.writer import CompressionType
from mcap.writer import Writer as McapFileWriter
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag1 import Writer as BagFileWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer

from mapper.runtime.atomic import atomic_file
from mapper.sources.ros.encode_ros import SerializedMessage
from mapper.sources.ros.typestore import definition, typestore

RecordingKind = Literal["mcap", "bag"]

_DEPTH = 100  # messages that wait for a slow subscriber: tf2's own


class MessageWriter(Protocol):
    """An open file of messages."""

    def write(self, message: SerializedMessage) -> None:
        """Append a message; its log time is its stamp."""
        ...


@contextmanager
def message_writer(path: Path, *, kind: RecordingKind) -> Iterator[MessageWriter]:
    """Yield a writer of a file, compressed by LZ4, that appears whole or not at all."""
    with atomic_file(path) as part:
        if kind == "bag":
            part.unlink()  # the writer of bags makes the file itself
            bag = BagFileWriter(part)
            bag.set_compression(BagFileWriter.CompressionFormat.LZ4)
            with bag:
                yield _BagWriter(bag)
        else:
            with part.open("wb") as file:
                mcap = McapFileWriter(file, compression=CompressionType.LZ4, enable_data_crcs=True)
                mcap.start(profile="ros2", library="mapper")
                yield _McapWriter(mcap)
                mcap.finish()


@contextmanager
def rosbag2_writer(folder: Path, *, name: str) -> Iterator[MessageWriter]:
    """Yield a writer of a ROS 2 bag in a folder: NAME.mcap, and ``metadata.yaml`` when it is whole.

    The metadata is of version 8, the last that ROS 2 Humble reads too.
    """
    bag = Bag2Writer(folder / name, version=8, storage_plugin=StoragePlugin.MCAP)  # names its file so, too
    bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with bag:
        yield _Bag2Writer(bag)
    for file in list(bag.path.iterdir()):
        file.replace(folder / file.name)
    bag.path.rmdir()


class _McapWriter:
    """Writer of an MCAP file; see :class:`MessageWriter`."""

    def __init__(self, writer: McapFileWriter) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, message: SerializedMessage) -> None:
        if message.topic not in self._channels:
            self._channels[message.topic] = self._register(message.topic, message.type)
        self._writer.add_message(
            self._channels[message.topic],
            log_time=message.stamp_ns,
            data=message.cdr,
            publish_time=message.stamp_ns,
        )

    def _register(self, topic: str, type_: str) -> int:
        if type_ not in self._schemas:
            text = definition(type_).encode()
            self._schemas[type_] = self._writer.register_schema(type_, "ros2msg", text)
        return int(self._writer.register_channel(topic, "cdr", self._schemas[type_]))


class _BagWriter:
    """Writer of a ROS 1 bag; see :class:`MessageWriter`."""

    def __init__(self, writer: BagFileWriter) -> None:
        self._writer = writer
        self._connections: dict[str, Any] = {}

    def write(self, message: SerializedMessage) -> None:
        if message.topic not in self._connections:
            self._connections[message.topic] = self._writer.add_connection(
                message.topic, message.type, typestore=typestore("ros1")
            )
        data = typestore("cdr").cdr_to_ros1(message.cdr, message.type)
        self._writer.write(self._connections[message.topic], message.stamp_ns, data)


class _Bag2Writer:
    """Writer of a ROS 2 bag; see :class:`MessageWriter`."""

    def __init__(self, writer: Bag2Writer) -> None:
        self._writer = writer
        self._connections: dict[str, Any] = {}

    def write(self, message: SerializedMessage) -> None:
        if message.topic not in self._connections:
            self._connections[message.topic] = self._writer.add_connection(
                message.topic,
                message.type,
                typestore=typestore("cdr"),
                offered_qos_profiles=[_quality(is_latched=message.is_latched)],
            )
        self._writer.write(self._connections[message.topic], message.stamp_ns, message.cdr)


def _quality(*, is_latched: bool) -> Qos:
    """Return the quality of service with which ``ros2 bag play`` publishes a topic."""
    unlimited = QosTime(0, 0)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if is_latched else _DEPTH,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if is_latched else QosDurability.VOLATILE,
        deadline=unlimited,
        lifespan=unlimited,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=unlimited,
        avoid_ros_namespace_conventions=False,
    )
