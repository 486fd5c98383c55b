"""Index of a recording: time and place of every message, from one pass that decodes headers only."""

import struct
from array import array
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, DependencyError, FrameError
from mapper.core.geometry import Array
from mapper.core.timebase import LATEST_NS, NS_PER_S, Stamps
from mapper.core.units import MIB
from mapper.sources.ros import decode_foxglove
from mapper.sources.ros.decode import decode, decompressed
from mapper.sources.ros.image_messages import size_of
from mapper.sources.ros.imu_messages import readings_of
from mapper.sources.ros.messages import IMUS, READ, SMALL, WITH_HEADER, ImageMessage, Message
from mapper.sources.ros.recording import Place, Recording, Topic

_TRIED = 10
_KEPT_BYTES = 32 * MIB


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Messages of one topic, in the order of the recording.

    Attributes:
        topic: Topic of the messages.
        stamps_ns: (N,) when they were measured, by their headers; ``log_ns`` where their type has none.
        log_ns: (N,) when they were recorded.
        places: (N, 3) block, offset and length of each.
        undated: Number of others without a header that can be read; they are left out.
        are_stamps_recorded: ``stamps_ns`` is ``log_ns``, because every header has the same stamp.
        kept: Bytes of small messages by their number: to read them again would unpack the whole file again.
        imu: (N, 6) angular velocity and acceleration of an IMU's messages, NaN of damaged ones; (0, 6) of
            other types.
    """

    topic: Topic
    stamps_ns: Stamps
    log_ns: Stamps
    places: NDArray[np.int64]
    undated: int
    are_stamps_recorded: bool = False
    kept: Mapping[int, bytes] = field(default_factory=dict)
    imu: Array = field(default_factory=lambda: np.empty((0, 6)))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def clock_ns(self) -> int:
        """Usual difference of the stamps to the times of recording."""
        return int(np.sort(self.stamps_ns - self.log_ns)[len(self) // 2])

    def place(self, i: int) -> Place:
        """Return where message ``i`` lies."""
        return Place(*self.places[i].tolist())


@dataclass(slots=True)
class _SeriesBuilder:
    """Messages of a topic found so far: 40 bytes each, 48 more of an IMU, and those that are kept whole."""

    stamps_ns: "array[int]" = field(default_factory=lambda: array("q"))
    log_ns: "array[int]" = field(default_factory=lambda: array("q"))
    places: "array[int]" = field(default_factory=lambda: array("q"))
    undated: int = 0
    kept: dict[int, bytes] = field(default_factory=dict)
    imu: "array[float]" = field(default_factory=lambda: array("d"))


def index_of(recording: Recording) -> Mapping[str, Series]:
    """Return the series of every topic that has messages, by its name."""
    builders: dict[Topic, _SeriesBuilder] = {}
    room_bytes = _KEPT_BYTES
    for topic, log_ns, place, data in recording.messages():
        series = builders.get(topic)
        if series is None:
            series = builders[topic] = _SeriesBuilder()
        try:
            stamp_ns = stamp_of(topic, data) if topic.type in WITH_HEADER else log_ns
        except DataError:
            stamp_ns = LATEST_NS
        if not (0 <= stamp_ns < LATEST_NS and 0 <= log_ns < LATEST_NS):
            series.undated += 1
            continue
        if topic.type in IMUS:
            series.imu.extend(readings_of(topic, data))
        elif topic.type in SMALL and len(data) <= room_bytes:
            series.kept[len(series.stamps_ns)] = bytes(data)
            room_bytes -= len(data)
        series.stamps_ns.append(stamp_ns)
        series.log_ns.append(log_ns)
        series.places.extend(place)
    return {
        topic.name: _finished(topic, series)
        for topic, series in sorted(builders.items(), key=lambda item: item[0].name)
        if series.stamps_ns
    }


def _finished(topic: Topic, series: _SeriesBuilder) -> Series:
    stamps_ns, log_ns = np.array(series.stamps_ns, np.int64), np.array(series.log_ns, np.int64)
    are_all_the_same = len(stamps_ns) > 1 and bool((stamps_ns == stamps_ns[0]).all())
    return Series(
        topic,
        stamps_ns=log_ns if are_all_the_same else stamps_ns,
        log_ns=log_ns,
        places=np.array(series.places, np.int64).reshape(-1, 3),
        undated=series.undated,
        are_stamps_recorded=are_all_the_same and not np.array_equal(stamps_ns, log_ns),
        kept=series.kept,
        imu=np.array(series.imu, np.float64).reshape(-1, 6),
    )


def first_messages(recording: Recording, series: Iterable[Series]) -> dict[str, Message]:
    """Return each topic's first message that is whole, by the topic's name; only of types that are read."""
    firsts: dict[str, Message] = {}
    for one in series:
        if one.topic.type not in READ:
            continue
        for i in range(min(_TRIED, len(one))):
            with suppress(DataError, DependencyError, FrameError):
                firsts[one.topic.name] = _whole_message(recording, one, i)
                break
    return firsts


def why_unread(recording: Recording, series: Series) -> str:
    """Return why the first message of a topic cannot be read, with its name; empty if it can."""
    try:
        _whole_message(recording, series, 0)
    except (DataError, DependencyError, FrameError) as error:
        return f"{series.topic.name}: {str(error).removeprefix(f'{series.topic.name}: ')}"
    return ""


def _whole_message(recording: Recording, series: Series, i: int) -> Message:
    """Return message ``i`` of a topic.

    Raises:
        DataError: It is damaged.
        FrameError: It cannot be read, or has no image although its type says so.
        DependencyError: The library that decodes it is not installed.
    """
    message = decode(series.topic, recording.read(series.place(i)))
    if isinstance(message, ImageMessage):
        size_of(message, where=series.topic.name)
    return message


def stamp_of(topic: Topic, data: memoryview) -> int:
    """Return the stamp with which a message with a header begins, nanoseconds.

    Raises:
        DataError: The message is too short to have one, or is written in an encoding that is not read.
    """
    if topic.encoding not in ("cdr", "ros1"):
        return decode_foxglove.stamp_of(topic, data)
    data = decompressed(topic, data)
    if len(data) < 12:
        raise DataError(f"{topic.name}: a message of {len(data)} bytes has no header")
    if topic.encoding == "ros1":  # a sequence number, then seconds and nanoseconds
        sec, nanosec = struct.unpack_from("<II", data, 4)
    else:  # CDR's own header of four bytes, whose second is the byte order
        sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(sec * NS_PER_S + nanosec)
