"""Ouster's recordings of scans (.osf), as ouster-cli and ouster-sdk write them.

Layout: the schemas in ouster_osf/fb of https://github.com/ouster-lidar/ouster-sdk. A file is a header, chunks
of messages and, last, metadata: buffers that each begin with their size and are followed by a CRC-32.
"""

import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO
from zlib import crc32

import cv2
import numpy as np
import zstandard
from numpy.typing import NDArray

from mapper.core.errors import DataError, FrameError, SourceError
from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.sources.base import BASES, Log
from mapper.sources.config import SourceConfig
from mapper.sources.flatbuffer import Table
from mapper.sources.image_files import png
from mapper.sources.ouster_packets import OusterSensor
from mapper.sources.point_times import LEAST_SHARE, MAX_SWEEP_S
from mapper.sources.ros.encode_ros import cloud_message
from mapper.sources.ros.ouster_recording import (
    CLOUD,
    FRAMES,
    LAST_NS,
    READING,
    SENSOR,
    frames_cdr,
    head_cdr,
    imu_cdr,
)
from mapper.sources.ros.reader import RecordingReader
from mapper.sources.ros.recording import Place, Recorded, Topic, check_block_size
from mapper.sources.ros.source import recording_log

_RANGES, _REFLECTIVITIES = (1, 2), (5, 6)
"""Numbers of the fields of the two returns of a beam."""
_TYPES = {1: "<u1", 2: "<u2", 3: "<u4", 4: "<u8"}
_ZPNG = struct.Struct("<HHHBB")  # magic, width, height, channels, bytes of each
_ZPNG_MAGIC = b"\xf8\xfb"
_FRAMES_AT, _CLOUD_AT = -2, -1


def recognise(path: Path) -> bool:
    """Return whether a path is called as such a recording is."""
    return path.suffix.lower() == ".osf" and path.is_file()


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a recording, with the inertial readings that its scans hold.

    Raises:
        SourceError: It is damaged or was cut before its metadata, or nothing in it can be mapped.
    """
    return recording_log(RecordingReader(OsfRecording(path)), config)


@dataclass(slots=True)
class _Stream:
    """Sensor and its scans: of each the stamp, time of recording, place, size, and columns measured."""

    name: str
    suffix: str
    sensor: OusterSensor
    base: str | None
    numbers: "array[int]" = field(default_factory=lambda: array("q"))

    def frames(self) -> memoryview:
        """Return the message of the sensor's frames."""
        return frames_cdr(self.sensor, self.numbers[0], suffix=self.suffix, base=self.base)


class OsfRecording:
    """File of scans as a recording of clouds and inertial readings; see :class:`Recording`.

    The block of a message's place is its sensor, the offset the number of its scan, and the length which of
    the scan's readings it is, ``_CLOUD_AT`` or ``_FRAMES_AT``.
    """

    kind = "ouster-osf"

    def __init__(self, path: Path) -> None:
        """Read the metadata.

        Raises:
            SourceError: As of :func:`read_log`.
        """
        self.path = path
        self.notes: list[str] = []
        self._streams: dict[int, _Stream] = {}
        try:
            with path.open("rb") as file:
                self._starts = self._read_metadata(file)
        except OSError as error:
            raise SourceError(f"{path}: cannot be read: {error.strerror}") from None
        except DataError as error:
            raise SourceError(f"{path}: no recording of an Ouster, or damaged: {error}") from None

    def _read_metadata(self, file: BinaryIO) -> list[int]:
        """Keep the sensors by the numbers of their streams, and return where the chunks begin."""
        header = _block(file, 0)
        if bytes(header[8:12]) != b"OSF$":
            raise DataError("it does not begin as one")
        try:
            root = Table.of_buffer(_block(file, Table.of_buffer(header).number(2, "Q", 1)))
        except DataError:
            raise DataError(
                "it was cut off: the metadata at its end, by which it is read, are lost"
            ) from None
        sensors: dict[int, OusterSensor] = {}
        streams: dict[int, int] = {}
        for entry in root.tables(4):
            number, content = entry.number(0, "I"), entry.bytes(2)
            if entry.text(1) == "ouster/v1/os_sensor/LidarSensor":
                text = Table.of_buffer(content).text(0)
                sensors[number] = OusterSensor(text, where=f"{self.path}: sensor {len(sensors)}")
            elif entry.text(1) == "ouster/v1/os_sensor/LidarScanStream":
                streams[number] = Table.of_buffer(content).number(0, "I")
        is_mounted = any((one.T_base_sensor != np.eye(4)).any() for one in sensors.values())
        suffixes = {one: f"_{i}" if len(sensors) > 1 else "" for i, one in enumerate(sensors)}
        for number, one in streams.items():
            if one in sensors:
                base = BASES[0] if is_mounted else None
                self._streams[number] = _Stream(f"/ouster{suffixes[one]}", suffixes[one], sensors[one], base)
        if not self._streams:
            raise DataError("its metadata name no stream of scans")
        return sorted({len(header) + 4 + int(at) for _, _, at in root.array(3, "<u8,<u8,<u8").tolist()})

    def messages(self) -> Iterator[Recorded]:
        """Yield every inertial reading, and then the frames of each sensor and the heads of its clouds."""
        damaged = end = 0
        with self.path.open("rb") as file:
            for start in self._starts:
                try:
                    if start < end:
                        raise DataError("within another")
                    data = _block(file, start)
                    end = start + len(data)
                    yield from self._read_chunk(data, start)
                except DataError:
                    damaged += 1
        if damaged:
            self.notes.append(f"{self.path.name}: {damaged} of {len(self._starts)} chunks are damaged; lost")
        for number, stream in self._streams.items():
            scans = np.array(stream.numbers, np.int64).reshape(-1, 5)
            if not len(scans):
                continue
            frames, place = Topic(f"{stream.name}/tf", FRAMES, "cdr"), Place(number, 0, _FRAMES_AT)
            yield Recorded(frames, int(scans[0, 1]), place, stream.frames())
            usual = int(np.median(scans[:, 4]))
            whole = np.flatnonzero(scans[:, 4] >= LEAST_SHARE * usual)
            if cut := len(scans) - len(whole):
                self.notes.append(f"{stream.name}: {cut} of {len(scans)} scans are cut; left out")
            if missing := int(np.maximum(usual - scans[whole, 4], 0).sum()):
                self.notes.append(f"{stream.name}: {missing} of {usual * len(whole)} columns are missing")
            clouds = Topic(f"{stream.name}/points", CLOUD, "cdr")
            for i in whole.tolist():
                head = memoryview(head_cdr(int(scans[i, 0]), SENSOR + stream.suffix))
                yield Recorded(clouds, int(scans[i, 1]), Place(number, i, _CLOUD_AT), head)

    def _read_chunk(self, data: memoryview, start: int) -> Iterator[Recorded]:
        """Keep the scans of a chunk, and yield the readings in them.

        Raises:
            DataError: It is damaged.
        """
        left = len(data)
        for message in Table.of_buffer(data).tables(0):
            stream = self._streams.get(number := message.number(1, "I"))
            at, size = message.span(2)
            left -= size  # hostile messages may all be the same bytes
            if stream is None or left < 0:
                continue
            scan, log_ns = Table.of_buffer(message.bytes(2)), message.number(0, "Q")
            columns_ns, is_measured = _columns(scan, stream.sensor)
            if not is_measured.any() or log_ns >= LAST_NS:
                continue
            times_ns = columns_ns[is_measured]
            near = times_ns[np.abs(times_ns - np.median(times_ns)) <= MAX_SWEEP_S * NS_PER_S]
            i = len(stream.numbers) // 5
            stream.numbers.extend((int(near.min()), log_ns, start + at, size, len(times_ns)))
            imu = Topic(f"{stream.name}/imu", READING, "cdr")
            for k, reading in enumerate(_readings(scan)):
                yield Recorded(imu, log_ns, Place(number, i, k), imu_cdr(*reading, suffix=stream.suffix))

    def read(self, place: Place) -> memoryview:
        """Return a message's bytes; safe in any thread.

        Raises:
            FrameError: The scan is damaged, or the file has changed.
        """
        stream = self._streams[place.block]
        stamp_ns, _, start, size, _ = stream.numbers[5 * place.offset : 5 * place.offset + 5]
        if place.length == _FRAMES_AT:
            return stream.frames()
        try:
            with self.path.open("rb") as file:
                file.seek(start)
                scan = Table.of_buffer(memoryview(file.read(size)))
            if place.length != _CLOUD_AT:
                return imu_cdr(*list(_readings(scan))[place.length], suffix=stream.suffix)
            columns_ns, is_measured = _columns(scan, stream.sensor)
            numbers = np.flatnonzero(is_measured)
            returns = [(a[:, numbers].T, b[:, numbers].T) for a, b in _returns(scan, stream.sensor)]
        except (DataError, IndexError, OSError) as error:
            raise FrameError(f"{stream.name}/points: {error}") from None
        cloud = stream.sensor.scan_of(returns, numbers, columns_ns[numbers], stamp_ns)
        return memoryview(cloud_message(stream.name, cloud, frame=SENSOR + stream.suffix).cdr)


def _block(file: BinaryIO, start: int) -> memoryview:
    """Return a buffer, without the checksum behind it.

    Raises:
        DataError: It goes beyond the end of the file, or its checksum is wrong.
    """
    start = min(start, file.seek(0, 2))
    file.seek(start)
    size = 4 + int.from_bytes(file.read(4), "little")
    check_block_size(size)
    file.seek(start)
    data, checksum = file.read(size), file.read(4)
    if crc32(data) != int.from_bytes(checksum, "little"):
        raise DataError("a wrong checksum")
    return memoryview(data)


def _columns(scan: Table, sensor: OusterSensor) -> tuple[Stamps, NDArray[np.bool_]]:
    """Return the time of each column, and which were measured.

    Raises:
        DataError: They are not as many as the sensor has.
    """
    ns, status = scan.array(2, "<u8"), scan.array(4, "<u4")
    if not len(ns) == len(status) == sensor.shape[1]:
        raise DataError(f"{len(ns)} columns, want {sensor.shape[1]}")
    return ns.astype(np.int64), (status & 1 == 1) & (ns > 0) & (ns < LAST_NS)


def _returns(
    scan: Table, sensor: OusterSensor
) -> list[tuple[NDArray[np.unsignedinteger], NDArray[np.unsignedinteger]]]:
    """Return (beams, columns) ranges in millimetres and reflectivities of each return of a beam."""
    kinds = scan.array(1, [("field", "u1"), ("type", "u1")])
    images: dict[int, NDArray[np.unsignedinteger]] = {}
    for (number, kind), channel in zip(kinds.tolist(), scan.tables(0), strict=False):
        if number in (*_RANGES, *_REFLECTIVITIES):
            images[number] = _pixels(
                channel.bytes(0), _TYPES.get(kind, ""), sensor.shape, shifts=sensor.shifts
            )
    found = [(images[a], images.get(b)) for a, b in zip(_RANGES, _REFLECTIVITIES, strict=True) if a in images]
    if not found:
        raise DataError("it has no ranges")
    return [(ranges, np.zeros_like(ranges) if second is None else second) for ranges, second in found]


def _readings(scan: Table) -> Iterator[tuple[int, Array, Array]]:
    """Yield the time, angular velocity (rad/s) and acceleration (m/s²) of each inertial reading of a scan."""
    fields = {one.text(0): one for one in scan.tables(8)}
    if not fields.keys() >= {"IMU_TIMESTAMP", "IMU_GYRO", "IMU_ACC", "IMU_STATUS"}:
        return
    try:
        stamps_ns = np.frombuffer(fields["IMU_TIMESTAMP"].bytes(4), "<u8")
        status = np.frombuffer(fields["IMU_STATUS"].bytes(4), "<u2")
    except ValueError:
        raise DataError("times that are no whole numbers") from None
    shape = len(stamps_ns), 3
    rates, felt = (
        _pixels(fields[one].bytes(4), "<f4", shape).astype(float) for one in ("IMU_GYRO", "IMU_ACC")
    )
    for ns, is_valid, *reading in zip(stamps_ns.tolist(), status & 1, rates, felt, strict=False):
        if is_valid and 0 < ns < LAST_NS:
            yield ns, *reading


def _pixels(
    data: memoryview, dtype: str, shape: tuple[int, int], *, shifts: list[int] | None = None
) -> NDArray[Any]:
    """Return an image of a field, whose columns are those of the sensor.

    Args:
        data: ZPNG or PNG.
        dtype: Type of the pixels.
        shape: (H, W) of the image.
        shifts: (H,) columns by which each row was moved before it became a PNG.

    Raises:
        DataError: It is of another encoding, size or type, or damaged.
    """
    if not dtype:
        raise DataError("a type of pixels that is not known")
    if bytes(data[:2]) == _ZPNG_MAGIC:
        return _zpng(data, np.dtype(dtype), shape)
    if bytes(data[:8]) != png.SIGNATURE:
        raise DataError(f"a field whose encoding is not known: it begins with {bytes(data[:4]).hex()}")
    if png.size_of(bytes(data[:64])) != shape[::-1]:
        raise DataError("a PNG of another size")
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.shape[:2] != shape:
        raise DataError("a damaged PNG")
    if pixels.ndim == 3:  # the bytes of a number are the red, green, blue and alpha of a pixel
        order = [2, 1, 0, 3][: pixels.shape[2]]
        pixels = (pixels[:, :, order].astype(np.uint32) << np.arange(0, 8 * len(order), 8)).sum(
            axis=2, dtype=np.uint32
        )
    pixels = np.ascontiguousarray(pixels, f"<u{np.dtype(dtype).itemsize}").view(dtype)
    if shifts is None:
        return pixels
    if len(shifts) != shape[0]:
        raise DataError(f"{len(shifts)} pixel_shift_by_row in the metadata, want {shape[0]}")
    columns = (np.arange(shape[1]) + np.array(shifts)[:, None]) % shape[1]
    return np.take_along_axis(pixels, columns, axis=1)


def _zpng(data: memoryview, dtype: np.dtype, shape: tuple[int, int]) -> NDArray[np.unsignedinteger]:
    """Return an image of ZPNG (https://github.com/catid/Zpng): packed differences along rows."""
    try:
        _, width, height, channels, channel_bytes = _ZPNG.unpack_from(data)
        size, depth = shape[0] * shape[1] * dtype.itemsize, channels * channel_bytes
        packed = data[_ZPNG.size :]
        if (height, width, depth) != (*shape, dtype.itemsize) or zstandard.frame_content_size(packed) != size:
            raise DataError("a ZPNG of another size")
        steps = np.frombuffer(zstandard.decompress(packed), np.uint8)
    except (struct.error, zstandard.ZstdError) as error:
        raise DataError(f"a damaged ZPNG: {error}") from None
    if len(steps) != size:
        raise DataError("a ZPNG of another size")
    if depth == 4:  # of red, green, blue and alpha it keeps blue, green − blue, green − red and alpha
        blue, green, red, alpha = steps.reshape(4, *shape)
        green = green + blue
        steps = np.stack([green - red, green, blue, alpha], axis=2)
    return np.cumsum(steps.reshape(*shape, depth), axis=1, dtype=np.uint8).view(dtype)[:, :, 0]
