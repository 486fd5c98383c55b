"""Recordings of LiDAR drivers' own messages, written by rosbags after the drivers' message definitions.

The definitions are those of livox_ros_driver (its README) and velodyne_msgs; a VLP-16's packets follow the
maker's manual (63-9243, chapter 9).
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import dpkt
import numpy as np
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mapper.core.frames import Scan
from mapper.core.trajectory import Trajectory
from mapper.simulation.config import STREET, LidarSensorConfig
from mapper.simulation.lidar.cast import cast
from mapper.simulation.lidar.source import LidarSimulator
from mapper.sources.ros.encode_ros import SerializedMessage

FIRST_NS = 1_700_000_000_000_000_000
_DEFINITIONS = {
    "CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\n"
    "uint8 reflectivity\nuint8 tag\nuint8 line",
    "CustomMsg": "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "CustomPoint[] points",
    "VelodynePacket": "time stamp\nuint8[1206] data",
    "VelodyneScan": "std_msgs/Header header\nVelodynePacket[] packets",
    "PacketMsg": "uint8[] buf",
}
_VLP16_RINGS_DEG = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])
_FIRING_S, _SEQUENCE_S, _SEQUENCES = 2.304e-6, 55.296e-6, 24
_PACKET_S = _SEQUENCES * _SEQUENCE_S
TURN = 75
"""Packets of a turn, nearly."""


class DriverRecording:
    """Bag of ROS 1 (``.bag``) or folder of ROS 2 with messages of a driver's types."""

    def __init__(self, path: Path, package: str) -> None:
        is_ros1 = path.suffix == ".bag"
        self._store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
        self._package = package
        self._serialize = self._store.serialize_ros1 if is_ros1 else self._store.serialize_cdr
        for name, text in _DEFINITIONS.items():
            if not is_ros1:
                text = text.replace("time stamp", "builtin_interfaces/Time stamp")
            self._store.register(get_types_from_msg(text, f"{package}/msg/{name}"))
        writer = (
            Bag1Writer(path) if is_ros1 else Bag2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        )
        self._writer: Any = writer
        self._is_ros1 = is_ros1
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> "DriverRecording":
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def make(self, type_: str, **fields: Any) -> Any:
        """Return a message of one of the driver's types, or of a standard one by its whole name."""
        return self._store.types[type_ if "/" in type_ else f"{self._package}/msg/{type_}"](**fields)

    def stamp(self, stamp_ns: int) -> Any:
        sec, nanosec = divmod(stamp_ns, 1_000_000_000)
        return self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)

    def header(self, stamp_ns: int, frame: str) -> Any:
        fields = {"seq": 0} if self._is_ros1 else {}
        return self.make("std_msgs/msg/Header", **fields, stamp=self.stamp(stamp_ns), frame_id=frame)

    def add(self, message: SerializedMessage) -> None:
        """Write a standard message."""
        self.write(message.stamp_ns, message.topic, self._store.deserialize_cdr(message.cdr, message.type))

    def write(self, stamp_ns: int, topic: str, message: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, message.__msgtype__, typestore=self._store
            )
        data = self._serialize(message, message.__msgtype__)
        self._writer.write(self._connections[topic], stamp_ns, data)


def street(*, rings: int = 16, azimuth_steps: int = 900, duration_s: float = 2.0) -> LidarSimulator:
    """A short way down a street; its sensor has the rings of a VLP-16."""
    sensor = LidarSensorConfig(
        rings=rings,
        azimuth_steps=azimuth_steps,
        lowest_ring_rad=float(np.radians(-15.0)),
        highest_ring_rad=float(np.radians(15.0)),
    )
    return LidarSimulator(STREET.model_copy(update={"duration_s": duration_s, "sensor": sensor}))


def write_livox(
    path: Path,
    scans: Iterable[Scan],
    *,
    package: str = "livox_ros_driver2",
    tags: Sequence[int] = (0,),
    frame: str = "livox_frame",
) -> Path:
    """Write scans with point times as CustomMsg; the tags are given to the points in turn."""
    with DriverRecording(path, package) as recording:
        for scan in scans:
            stamp_ns = scan.stamp_ns
            assert scan.times_s is not None
            offsets_ns = np.rint(scan.times_s.astype(np.float64) * 1e9).astype(int).tolist()
            points = [
                recording.make(
                    "CustomPoint",
                    offset_time=offset_ns, x=x, y=y, z=z, reflectivity=9, tag=tags[i % len(tags)], line=i % 4,
                )
                for i, (offset_ns, (x, y, z)) in enumerate(
                    zip(offsets_ns, scan.points_body.tolist(), strict=True)
                )
            ]  # fmt: skip
            message = recording.make(
                "CustomMsg",
                header=recording.header(stamp_ns, frame),
                timebase=stamp_ns,
                point_num=len(points),
                lidar_id=0,
                rsvd=np.zeros(3, np.uint8),
                points=points,
            )
            recording.write(stamp_ns, "/livox/lidar", message)
    return path


def write_vlp16(path: Path, simulator: LidarSimulator, *, scans: int) -> tuple[Path, Trajectory]:
    """Write what a VLP-16 would send down a street, and return the truth at the scans' stamps.

    A packet has 12 blocks of two sequences of 16 firings: distances of 2 mm, azimuths of 0.01° clockwise from
    ahead, and µs after the hour. The driver stamps a scan with its last packet's time.
    """
    stamps_ns = []
    with DriverRecording(path, "velodyne_msgs") as recording:
        for scan in range(scans):
            packets = [
                recording.make("VelodynePacket", stamp=recording.stamp(stamp_ns), data=data)
                for stamp_ns, data in vlp16_packets(simulator, range(scan * TURN, (scan + 1) * TURN))
            ]
            stamp_ns = FIRST_NS + round(((scan + 1) * TURN - 1) * _PACKET_S * 1e9)
            stamps_ns.append(stamp_ns)
            message = recording.make(
                "VelodyneScan", header=recording.header(stamp_ns, "velodyne"), packets=packets
            )
            recording.write(stamp_ns, "/velodyne_packets", message)
    stamps = np.array(stamps_ns, np.int64)
    return path, Trajectory(stamps, simulator.drive.poses((stamps - FIRST_NS) / 1e9))


def write_pcap(path: Path, simulator: LidarSimulator, *, packets: int) -> Path:
    """Write what a VLP-16 sends in a street, and its position packets, as tcpdump captures them."""

    def sent() -> Iterator[tuple[int, int, bytes]]:
        for number, (stamp_ns, data) in enumerate(vlp16_packets(simulator, range(packets))):
            if number % 50 == 0:
                yield stamp_ns, 8308, bytes(512)
            yield stamp_ns, 2368, data.tobytes()

    return write_captured(path, sent())


def write_datagrams(path: Path, payloads: Iterable[bytes], *, port: int) -> Path:
    """Write a capture of datagrams to a port, a millisecond apart."""
    return write_captured(path, ((FIRST_NS + 10**6 * k, port, one) for k, one in enumerate(payloads)))


def write_captured(path: Path, datagrams: Iterable[tuple[int, int, bytes]]) -> Path:
    """Write datagrams as tcpdump captures them, in fragments of an Ethernet.

    Args:
        path: File to write, ``.pcapng`` or else pcap.
        datagrams: When each was received, nanoseconds; the port that it was sent to; its content.
    """
    with path.open("wb") as file:
        writer = (dpkt.pcapng.Writer if path.suffix == ".pcapng" else dpkt.pcap.Writer)(file)
        for number, (received_ns, port, payload) in enumerate(datagrams):
            for frame in _frames(payload, port=port, number=number % (1 << 16)):
                writer.writepkt(frame, ts=received_ns / 1e9)
    return path


def _frames(payload: bytes, *, port: int, number: int, most: int = 1480) -> list[bytes]:
    """Return the Ethernet frames of a datagram."""
    whole = bytes(dpkt.udp.UDP(sport=7502, dport=port, ulen=8 + len(payload), data=payload))
    frames = []
    for start in range(0, len(whole), most):
        more = 0x2000 if start + most < len(whole) else 0
        ip = dpkt.ip.IP(
            src=bytes([192, 168, 1, 201]),
            dst=bytes([192, 168, 1, 10]),
            p=dpkt.ip.IP_PROTO_UDP,
            id=number,
            data=whole[start : start + most],
        )
        ip._flags_offset = more | start // 8
        ip.len = len(ip)
        frames.append(bytes(dpkt.ethernet.Ethernet(src=bytes(6), dst=bytes(6), data=ip)))
    return frames


def vlp16_packets(simulator: LidarSimulator, numbers: Iterable[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the time in nanoseconds and the content of the packets of some numbers."""
    elevations = np.radians(_VLP16_RINGS_DEG)
    for number in numbers:
        start_s = number * _PACKET_S
        sequence_s = start_s + np.arange(_SEQUENCES) * _SEQUENCE_S
        fired_s = sequence_s[:, None] + np.arange(16) * _FIRING_S
        azimuths = np.radians(fired_s * 3600.0)  # ten turns a second
        flat = np.cos(elevations)
        rays_lidar = np.stack(
            [flat * np.cos(azimuths), -flat * np.sin(azimuths), np.sin(elevations) + 0.0 * azimuths], axis=2
        )
        poses = simulator.drive.poses(sequence_s)
        rays = np.ascontiguousarray(rays_lidar @ poses[:, :3, :3].transpose(0, 2, 1))
        ranges_m = cast(simulator.scene.world, np.ascontiguousarray(poses[:, :3, 3]), rays, 80.0, True)
        units = np.where(np.isfinite(ranges_m), np.rint(ranges_m / 0.002), 0).astype("<u2")
        yield FIRST_NS + round(start_s * 1e9), _packet(units, np.degrees(azimuths[:, 0]), start_s)


def _packet(units: np.ndarray, azimuths_deg: np.ndarray, start_s: float) -> np.ndarray:
    blocks = b""
    for block in range(12):
        azimuth = round(azimuths_deg[2 * block] * 100.0) % 36_000
        channels = np.zeros(32, np.dtype([("distance", "<u2"), ("reflectivity", "u1")]))
        channels["distance"] = units[2 * block : 2 * block + 2].ravel()
        blocks += b"\xff\xee" + azimuth.to_bytes(2, "little") + channels.tobytes()
    strongest, vlp16 = 0x37, 0x22
    factory = bytes([strongest, vlp16])
    return np.frombuffer(blocks + round(start_s * 1e6).to_bytes(4, "little") + factory, np.uint8)
