"""Index of a recording: time and place of every message, from one pass that decodes headers only."""

import struct
from array import array
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import nan

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, DependencyError, FrameError
from mapper.core.geometry import Array
from mapper.core.timebase import LATEST_NS, NS_PER_S, Stamps
from mapper.core.units import MIB
from mapper.sources.ros import decode_foxglove
from mapper.sources.ros.decode import decode, decompressed
from mapper.sources.ros.image_messages import size_of
from mapper.sources.ros.messages import (
    CLOUDS,
    IMUS,
    READ,
    SMALL,
    WITH_HEADER,
    CameraMessage,
    ImageMessage,
    Message,
)
from mapper.sources.ros.recording import Place, Recording, Topic

_TRIED = 10
_KEPT_BYTES = 32 * MIB
_LONGEST_FRAME = 256  # bytes
_UNPACK = {order: struct.Struct(f"{order}104x3d72x3d72x") for order in "<>"}
"""Orientation and its covariance, angular velocity, covariance, acceleration, covariance: 37 doubles."""
_HEADER_BYTES = 12  # a counter (ROS 1) or the encapsulation (CDR), seconds and nanoseconds; then the frame
_NONE = (nan,) * 6


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Messages of one topic, in the order of the recording.

    Attributes:
        topic: Topic of the messages.
        stamps_ns: (N,) when they were measured, by their headers; ``log_ns`` where their type has none.
        log_ns: (N,) when they were recorded.
        places: (N, 3) block, offset and length of each.
        undated: Number of others without a header that can be read; they are left out.
        restamped: Number of headers without a stamp of their own, whose ``stamps_ns`` are of the recording.
        frames: Coordinate frames that a cloud's headers name, in order of appearance.
        frame_numbers: (N,) index of each cloud's in ``frames``; (0,) of other types.
        kept: Bytes of small messages by their number: to read them again would unpack the whole file again.
        imu: (N, 6) angular velocity and acceleration of an IMU's messages, NaN of damaged ones; (0, 6) of
            other types.
    """

    topic: Topic
    stamps_ns: Stamps
    log_ns: Stamps
    places: NDArray[np.int64]
    undated: int
    restamped: int = 0
    frames: Sequence[str] = ()
    frame_numbers: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))
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
    frames: dict[str, int] = field(default_factory=dict)
    frame_numbers: "array[int]" = field(default_factory=lambda: array("q"))


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
        elif topic.type in CLOUDS and topic.encoding in ("cdr", "ros1"):
            frame = _header_frame(topic, data)
            series.frame_numbers.append(series.frames.setdefault(frame, len(series.frames)))
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
    is_unset = _are_unset(stamps_ns, log_ns)
    if is_unset.any():
        clock_ns = np.int64(np.median((stamps_ns - log_ns)[~is_unset])) if not is_unset.all() else 0
        stamps_ns = np.where(is_unset, log_ns + clock_ns, stamps_ns)
    return Series(
        topic,
        stamps_ns=stamps_ns,
        log_ns=log_ns,
        places=np.array(series.places, np.int64).reshape(-1, 3),
        undated=series.undated,
        restamped=int(is_unset.sum()),
        frames=tuple(series.frames),
        frame_numbers=np.array(series.frame_numbers, np.intp),
        kept=series.kept,
        imu=np.array(series.imu, np.float64).reshape(-1, 6),
    )


def _are_unset(stamps_ns: Stamps, log_ns: Stamps) -> NDArray[np.bool_]:
    """Return which stamps their driver has not set: 0 unlike the others', or all where most are repeated."""
    different, recorded = len(np.unique(stamps_ns)), len(np.unique(log_ns))
    if different < recorded and (different == 1 or 2 * different < len(stamps_ns)):
        return np.full(len(stamps_ns), True)
    is_zero = stamps_ns == 0
    if not is_zero.any() or is_zero.all():
        return np.full(len(stamps_ns), False)
    expected_ns = log_ns + np.int64(np.median((stamps_ns - log_ns)[~is_zero]))
    unset: NDArray[np.bool_] = is_zero & (np.abs(expected_ns) > NS_PER_S)
    return unset


def first_messages(recording: Recording, series: Iterable[Series]) -> dict[str, Message]:
    """Return each topic's first message that is whole, by the topic's name; only of types that are read.

    Of calibrations it is the first that is one: some drivers publish zeros until they have theirs.
    """
    firsts: dict[str, Message] = {}
    for one in series:
        if one.topic.type not in READ:
            continue
        for i in range(min(_TRIED, len(one))):
            with suppress(DataError, DependencyError, FrameError):
                message = _whole_message(recording, one, i)
                firsts.setdefault(one.topic.name, message)
                if isinstance(message, CameraMessage) and not message.K[:1].any():
                    continue
                firsts[one.topic.name] = message
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
    """Return the stamp with which a message with a header begins, nanoseconds; 0 where it is no time.

    Raises:
        DataError: The message is too short to have one, or is written in an encoding that is not read.
    """
    if topic.encoding not in ("cdr", "ros1"):
        return decode_foxglove.stamp_of(topic, data)
    data = decompressed(topic, data)
    if len(data) < _HEADER_BYTES:
        raise DataError(f"{topic.name}: a message of {len(data)} bytes has no header")
    if topic.encoding == "ros1":  # a sequence number, then seconds and nanoseconds
        sec, nanosec = struct.unpack_from("<II", data, 4)
    else:  # CDR's own header of four bytes, whose second is the byte order
        sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(sec * NS_PER_S + nanosec) if nanosec < NS_PER_S else 0


def _header_frame(topic: Topic, data: memoryview) -> str:
    """Return the coordinate frame that a message's header names; empty if it is damaged."""
    with suppress(DataError, struct.error):
        data = decompressed(topic, data)
        order = "<" if topic.encoding == "ros1" or data[1] & 1 else ">"
        (length,) = struct.unpack_from(f"{order}I", data, _HEADER_BYTES)
        name = bytes(data[_HEADER_BYTES + 4 :][: min(length, _LONGEST_FRAME)])
        return name.rstrip(b"\0").decode(errors="replace").lstrip("/")
    return ""


def readings_of(topic: Topic, data: memoryview) -> tuple[float, ...]:
    """Return the angular velocity and the acceleration, six numbers; NaN of a message that is damaged.

    The numbers end a message in both CDR and ROS 1, so the length of the frame's name does not matter.
    """
    try:
        data = decompressed(topic, data)
    except DataError:
        return _NONE
    order = "<" if topic.encoding == "ros1" or bytes(data[1:2]) == b"\1" else ">"
    offset = len(data) - _UNPACK[order].size
    if topic.encoding not in ("cdr", "ros1") or offset < _HEADER_BYTES:
        return _NONE
    return _UNPACK[order].unpack_from(data, offset)
