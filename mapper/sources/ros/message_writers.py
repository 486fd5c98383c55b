"""Messages written as recordings: MCAP files (ROS 2), ROS 1 bags and ROS 2 bags."""

from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, Literal

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer

from mapper.runtime.atomic import atomic_file
from mapper.sources.ros.encode_ros import SerializedMessage
from mapper.sources.ros.typestore import definition, typestore

RecordingKind = Literal["mcap", "bag"]

_DEPTH = 100  # messages that wait for a slow subscriber: tf2's own


def write_recording_file(path: Path, messages: Iterable[SerializedMessage], *, kind: RecordingKind) -> None:
    """Write messages, whose log times are their stamps, into a file that appears whole or not at all."""
    with atomic_file(path) as part:
        (_write_mcap if kind == "mcap" else _write_bag)(part, messages)


def _write_mcap(path: Path, messages: Iterable[SerializedMessage]) -> None:
    with path.open("wb") as file:
        mcap = McapWriter(file, compression=CompressionType.LZ4, enable_data_crcs=True)

        @cache
        def schema(type_: str) -> Any:
            return mcap.register_schema(type_, "ros2msg", definition(type_).encode())

        @cache
        def channel(topic: str, type_: str) -> Any:
            return mcap.register_channel(topic, "cdr", schema(type_))

        mcap.start(profile="ros2", library="mapper")
        for stamp_ns, topic, type_, cdr, _ in messages:
            mcap.add_message(channel(topic, type_), log_time=stamp_ns, data=cdr, publish_time=stamp_ns)
        mcap.finish()


def _write_bag(path: Path, messages: Iterable[SerializedMessage]) -> None:
    path.unlink()  # its writer makes the file itself
    bag = BagWriter(path)
    bag.set_compression(BagWriter.CompressionFormat.LZ4)

    @cache
    def connection(topic: str, type_: str) -> Any:
        return bag.add_connection(topic, type_, typestore=typestore("ros1"))

    with bag:
        for stamp_ns, topic, type_, cdr, _ in messages:
            bag.write(connection(topic, type_), stamp_ns, typestore("cdr").cdr_to_ros1(cdr, type_))


def write_rosbag2(folder: Path, messages: Iterable[SerializedMessage], *, name: str) -> None:
    """Write messages as a ROS 2 bag in a folder: NAME.mcap, and ``metadata.yaml`` when it is whole.

    The metadata is of version 8, the last that ROS 2 Humble reads too.
    """
    bag = Bag2Writer(folder / name, version=8, storage_plugin=StoragePlugin.MCAP)  # names its file so, too
    bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)

    @cache
    def connection(topic: str, type_: str, is_latched: bool) -> Any:
        quality = _quality(is_latched=is_latched)
        return bag.add_connection(topic, type_, typestore=typestore("cdr"), offered_qos_profiles=[quality])

    with bag:
        for stamp_ns, topic, type_, cdr, is_latched in messages:
            bag.write(connection(topic, type_, is_latched), stamp_ns, cdr)
    for file in list(bag.path.iterdir()):
        file.replace(folder / file.name)
    bag.path.rmdir()


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
