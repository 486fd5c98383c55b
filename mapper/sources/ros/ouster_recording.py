"""Recordings of an Ouster's packets, as if its driver had published their clouds and inertial readings."""

import struct
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, FrameError, SourceError
from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.sources.ouster_packets import HEAD_BYTES, OusterSensor, imu_readings, is_imu, metadata_beside
from mapper.sources.point_times import LEAST_SHARE, MAX_SWEEP_S
from mapper.sources.ros.decode import decompressed
from mapper.sources.ros.encode_ros import cloud_message, transforms_message
from mapper.sources.ros.messages import CLOUDS, IMAGES, OUSTER_PACKETS
from mapper.sources.ros.recording import Place, Recorded, Recording, Topic
from mapper.sources.ros.topic_ranks import shared_namespaces

SENSOR, _LIDAR, _IMU = "os_sensor", "os_lidar", "os_imu"
"""The driver's names of its frames."""
CLOUD, READING, FRAMES = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Imu", "tf2_msgs/msg/TFMessage"
_STRING = "std_msgs/msg/String"
_CDR = b"\0\1\0\0"
_FRAMES_AT = -1
LAST_NS = (1 << 31) * NS_PER_S
_LATE_TURNS = 3
"""A packet of so few turns ago was late; a larger step is a sensor that began anew to count."""

_Scan = tuple[int, NDArray[np.intp]]


@dataclass(slots=True)
class _Stream:
    """Packets of a topic: when and where each was recorded, four numbers; sizes and heads of a LiDAR's."""

    topic: Topic
    numbers: "array[int]" = field(default_factory=lambda: array("q"))
    sizes: "array[int]" = field(default_factory=lambda: array("q"))
    heads: bytearray = field(default_factory=bytearray)
    sensor: OusterSensor | None = None
    scans: Sequence[_Scan] = ()

    def add(self, log_ns: int, place: Place) -> None:
        """Add a packet."""
        self.numbers.extend((log_ns, *place))

    def place(self, i: int) -> Place:
        """Return where packet ``i`` lies."""
        return Place(*self.numbers[4 * i + 1 : 4 * i + 4])


class OusterRecording:
    """Recording whose packets are replaced by the messages that they become; see :class:`Recording`.

    Messages of other types stay as they are. Virtual ones have places of negative blocks, a block a stream: a
    cloud's offset is its number, an inertial reading's that of its packet.
    """

    def __init__(self, recording: Recording) -> None:
        """Wrap a recording, with or without packets."""
        self.path = recording.path
        self.kind = recording.kind
        self._inner = recording
        self._streams: list[_Stream] = []
        self._notes: list[str] = []

    @property
    def notes(self) -> Sequence[str]:
        """Return what was lost, a sentence each."""
        return [*self._inner.notes, *self._notes]

    def messages(self) -> Iterator[Recorded]:
        """Yield every message: clouds after all others, as the metadata may be anywhere among the packets.

        Raises:
            SourceError: Packets alone could be mapped, and the sensor's metadata are missing or damaged.
        """
        clouds: dict[str, _Stream] = {}
        readings: dict[str, _Stream] = {}
        sensors: dict[str, OusterSensor] = {}
        damaged: dict[str, int] = {}
        types: set[str] = set()
        for recorded in self._inner.messages():
            topic, log_ns, place, data = recorded
            if topic.type == _STRING and "metadata" in topic.name:
                self._read_metadata(topic, data, sensors)
            if topic.type not in OUSTER_PACKETS:
                types.add(topic.type)
                yield recorded
                continue
            packet = _packet_of(topic, data)
            if packet is None or not is_imu(packet):
                stream = self._stream_of(topic, clouds)
                stream.add(log_ns, place)
                stream.sizes.append(0 if packet is None else len(packet))
                stream.heads += bytes((packet or b"")[:HEAD_BYTES]).ljust(HEAD_BYTES, b"\0")
                continue
            stream = self._stream_of(topic, readings)
            number = len(stream.numbers) // 4
            stream.add(log_ns, place)
            block = -1 - self._streams.index(stream)
            for k, reading in enumerate(imu_readings(packet)):
                if reading[0] < LAST_NS:
                    topic = Topic(stream.topic.name, READING, "cdr")
                    yield Recorded(topic, log_ns, Place(block, number, k), imu_cdr(*reading))
                else:
                    damaged[topic.name] = damaged.get(topic.name, 0) + 1
        self._notes += [f"{name}: {count} damaged readings; left out" for name, count in damaged.items()]
        for stream in clouds.values():
            yield from self._clouds(stream, sensors)
        if clouds and not (types & (CLOUDS | IMAGES) or any(stream.sensor for stream in clouds.values())):
            raise SourceError(f"{self.path}: {'; '.join(self.notes)}")

    def read(self, place: Place) -> memoryview:
        """Return a message's bytes; safe in any thread.

        Raises:
            FrameError: As of the recording, or its packets have changed.
        """
        if place.block >= 0:
            return self._inner.read(place)
        stream = self._streams[-1 - place.block]
        if stream.sensor is None:
            readings = list(imu_readings(self._packet(stream, place.offset)))
            return imu_cdr(*readings[place.length])
        if place.offset == _FRAMES_AT:
            return frames_cdr(stream.sensor, stream.scans[0][0])
        stamp_ns, packets = stream.scans[place.offset]
        scan = stream.sensor.scan([self._packet(stream, i) for i in packets.tolist()], stamp_ns)
        return memoryview(cloud_message(stream.topic.name, scan, frame=SENSOR).cdr)

    def _packet(self, stream: _Stream, i: int) -> memoryview:
        packet = _packet_of(stream.topic, self._inner.read(stream.place(i)))
        if packet is None or (stream.sensor is not None and len(packet) != stream.sensor.packet_bytes):
            raise FrameError(f"{self.path}: {stream.topic.name}: packet {i} has changed")
        return packet

    def _stream_of(self, topic: Topic, streams: dict[str, _Stream]) -> _Stream:
        if topic.name not in streams:
            streams[topic.name] = _Stream(topic)
            self._streams.append(streams[topic.name])
        return streams[topic.name]

    def _read_metadata(self, topic: Topic, data: memoryview, sensors: dict[str, OusterSensor]) -> None:
        text = bytes(_packet_of(topic, data) or b"").rstrip(b"\0").decode(errors="replace")
        try:
            sensors.setdefault(topic.name, OusterSensor(text, where=topic.name))
        except SourceError as error:
            self._notes.append(f"{error}")

    def _clouds(self, stream: _Stream, sensors: Mapping[str, OusterSensor]) -> Iterator[Recorded]:
        """Yield the sensor's frames, and the head of a cloud for each turn of it."""
        name, sizes = stream.topic.name, np.array(stream.sizes, np.int64)
        sensor = self._sensor_of(stream, sizes, sensors)
        if sensor is None:
            return
        turns, stamps_ns, _ = sensor.heads(stream.heads)
        is_sound = (sizes == sensor.packet_bytes) & (stamps_ns >= 0) & (stamps_ns < LAST_NS)
        if not is_sound.all():
            self._notes.append(
                f"{name}: {(~is_sound).sum()} of {len(sizes)} packets are damaged or have another size than "
                f"{sensor.packet_bytes} bytes; left out"
            )
        if not is_sound.any():
            return
        scans = _scans(np.flatnonzero(is_sound), turns, stamps_ns)
        usual = int(np.median([len(packets) for _, packets in scans]))
        stream.sensor = sensor
        stream.scans = [one for one in scans if len(one[1]) >= LEAST_SHARE * usual]
        if len(stream.scans) < len(scans):
            self._notes.append(
                f"{name}: {len(scans) - len(stream.scans)} of {len(scans)} scans are cut; left out"
            )
        if missing := sum(max(0, usual - len(packets)) for _, packets in stream.scans):
            self._notes.append(f"{name}: {missing} of {usual * len(stream.scans)} packets are missing")
        block, log_ns = -1 - self._streams.index(stream), stream.numbers[::4]
        frames, first_ns = Topic(f"{name}/tf", FRAMES, "cdr"), stream.scans[0][0]
        yield Recorded(frames, log_ns[0], Place(block, _FRAMES_AT, 0), frames_cdr(sensor, first_ns))
        for number, (stamp_ns, packets) in enumerate(stream.scans):
            place, head = Place(block, number, 0), memoryview(head_cdr(stamp_ns, SENSOR))
            yield Recorded(Topic(name, CLOUD, "cdr"), log_ns[int(packets[0])], place, head)

    def _sensor_of(
        self, stream: _Stream, sizes: NDArray[np.int64], sensors: Mapping[str, OusterSensor]
    ) -> OusterSensor | None:
        """Return the sensor that fits the packets: by metadata of their namespace first, by files last."""
        name, size = stream.topic.name, int(np.bincount(sizes).argmax())
        found = sorted(sensors.items(), key=lambda one: -shared_namespaces(one[0], name))
        beside, problems = metadata_beside(self.path)
        candidates = [*(sensor for _, sensor in found), *beside]
        for sensor in candidates:
            _, _, serials = sensor.heads(stream.heads)
            serial = int(np.median(serials[sizes == size]))
            if sensor.packet_bytes == size and (0 in (serial, sensor.serial) or serial == sensor.serial):
                self._notes.append(f"{name}: packets decoded by the metadata of {sensor.where}")
                return sensor
        others = [
            f"{one.where} is of sensor {one.serial}, {one.packet_bytes} bytes a packet" for one in candidates
        ]
        where = "" if stream.topic.encoding == "udp" else ", or record its metadata topic too"
        self._notes.append(
            f"{name}: {len(sizes)} packets of an Ouster, of {size} bytes, but not the metadata that say "
            f"where its beams point: put them beside the log as {self.path.stem}.json{where}"
            + "".join(f"; {one}" for one in [*others, *problems])
        )
        return None


def _scans(sound: NDArray[np.intp], turns: NDArray[np.int64], stamps_ns: Stamps) -> list[_Scan]:
    """Return the scans of packets, each with its first column's time and the packets' indices."""
    steps = _steps(turns[sound])
    # A jump there and back is a damaged number.
    alone = (np.abs(steps) > _LATE_TURNS) & (np.roll(turns[sound], 1) == np.roll(turns[sound], -1))
    sound = sound[~alone]
    steps = _steps(turns[sound])
    counted = np.cumsum(np.where(np.abs(steps) <= _LATE_TURNS, steps, 1))
    order = np.argsort(counted, kind="stable")
    scans = []
    for packets in np.split(sound[order], np.flatnonzero(np.diff(counted[order])) + 1):
        stamps = stamps_ns[packets]
        near = stamps[np.abs(stamps - np.median(stamps)) <= MAX_SWEEP_S * NS_PER_S]
        scans.append((int(near.min(initial=stamps.max())), packets))
    return scans


def _steps(turns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return by how much the count of turns, which has 16 bits, has grown at each packet."""
    return (np.diff(turns, prepend=turns[:1]) + (1 << 15)) % (1 << 16) - (1 << 15)


def _packet_of(topic: Topic, data: memoryview) -> memoryview | None:
    """Return the bytes of a PacketMsg, or the characters of a String; None of a damaged message."""
    if topic.encoding not in ("cdr", "ros1"):
        return data
    start = 0 if topic.encoding == "ros1" else len(_CDR)
    try:
        data = decompressed(topic, data)
        order = ">" if start and not data[1] & 1 else "<"
        (size,) = struct.unpack_from(f"{order}I", data, start)
    except (DataError, IndexError, struct.error):
        return None
    found = data[start + 4 :][:size]
    return found if len(found) == size else None


def head_cdr(stamp_ns: int, frame: str) -> bytes:
    """Return how a message with a header begins."""
    name = frame.encode() + b"\0"
    return struct.pack(f"<4siII{len(name)}s", _CDR, *divmod(stamp_ns, NS_PER_S), len(name), name)


def imu_cdr(stamp_ns: int, rates_radps: Array, acceleration_mps2: Array, *, suffix: str = "") -> memoryview:
    """Return an Imu in the frame of a sensor's IMU."""
    head = head_cdr(stamp_ns, _IMU + suffix)
    numbers = (*(0.0,) * 13, *rates_radps.tolist(), *(0.0,) * 9, *acceleration_mps2.tolist(), *(0.0,) * 9)
    return memoryview(head + bytes((len(_CDR) - len(head)) % 8) + struct.pack("<37d", *numbers))


def frames_cdr(
    sensor: OusterSensor, stamp_ns: int, *, suffix: str = "", base: str | None = None
) -> memoryview:
    """Return the transforms of a sensor's frames, and that from a base on which it is mounted."""
    own = SENSOR + suffix
    links = [(own, _LIDAR + suffix, sensor.T_sensor_lidar), (own, _IMU + suffix, sensor.T_sensor_imu)]
    if base is not None:
        links.append((base, own, sensor.T_base_sensor))
    return memoryview(transforms_message(stamp_ns, "", links).cdr)
