"""An Ouster's packets, decoded to points and inertial readings by the sensor's metadata.

Layouts and equations: Ouster's sensor documentation, *Lidar Data Packet Format*, *Lidar Range to XYZ* and
*IMU Data* (https://static.ouster.dev/sensor-docs). All numbers are little-endian.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, FiniteFloat, model_validator

from mapper.core.errors import DataError, SourceError
from mapper.core.frames import Scan
from mapper.core.geometry import Array, Transform, is_rigid
from mapper.core.timebase import LATEST_NS, NS_PER_S, Stamps
from mapper.core.units import GRAVITY_MPS2, MIB, MM_PER_M
from mapper.runtime.regular_files import read_text
from mapper.sources.json_files import parse_json

HEAD_BYTES = 44
"""Bytes of a packet up to the first column's time, from which scans are put together."""
_HEADER_BYTES, _FOOTER_BYTES = 32, 32
_IMU_BYTES, _IMU_TYPE = 48, 2
_IMU = np.dtype(
    [
        ("system_ns", "<u8"),
        ("acceleration_ns", "<u8"),
        ("ns", "<u8"),
        ("acceleration", "<f4", 3),
        ("rate", "<f4", 3),
    ]
)
_IMU_SAMPLE = np.dtype(
    [("ns", "<u8"), ("number", "<u2"), ("status", "<u2"), ("acceleration", "<f4", 3), ("rate", "<f4", 3)]
)
_NMEA_BYTES = 100
_KEY = "beam_altitude_angles"
_MOST_TRIED = 20
"""JSON files in a log's folder that are looked at."""


class _Layout(NamedTuple):
    """Layout of a pixel: its bytes, the bits of a range, millimetres per unit, and its returns.

    Return k has its range in the lowest bits of 32-bit word k, its reflectivity ``reflectivity`` bytes on.
    """

    pixel_bytes: int
    range_bits: int
    unit_mm: int
    returns: int
    reflectivity: int


_LAYOUTS = {
    "LEGACY": _Layout(12, 20, 1, 1, 4),
    "RNG19_RFL8_SIG16_NIR16": _Layout(12, 19, 1, 1, 4),
    "RNG19_RFL8_SIG16_NIR16_ZONE16": _Layout(12, 19, 1, 1, 4),
    "RNG19_RFL8_SIG16_NIR16_RGB16": _Layout(16, 19, 1, 1, 3),
    "RNG19_RFL8_SIG16_NIR16_DUAL": _Layout(16, 19, 1, 2, 3),
    "RNG19_RFL8_SIG16_ZONE16_DUAL": _Layout(16, 19, 1, 2, 3),
    "RNG19_RFL8_SIG16_NIR16_RGB16_DUAL": _Layout(20, 19, 1, 2, 3),
    "RNG15_RFL8_NIR8": _Layout(4, 15, 8, 1, 2),
    "RNG15_RFL8_WIN8": _Layout(4, 15, 8, 1, 2),
    "RNG15_RFL8_NIR8_ZONE16": _Layout(8, 15, 8, 1, 2),
    "RNG15_RFL8_NIR8_DUAL": _Layout(8, 15, 8, 2, 2),
    "FUSA_RNG15_RFL8_NIR8_DUAL": _Layout(8, 15, 8, 2, 2),
}
"""By the metadata's ``udp_profile_lidar``."""

Beams = Annotated[list[FiniteFloat], Field(min_length=1, max_length=256)]
Matrix = Annotated[list[FiniteFloat], Field(min_length=16, max_length=16)]


class OusterMetadata(BaseModel):
    """What is read of a sensor's metadata, flat as older clients wrote them, or in sections."""

    beam_altitude_angles: Beams
    beam_azimuth_angles: Beams
    lidar_mode: str = ""
    columns_per_frame: int = Field(default=1024, ge=1, le=1 << 12)
    columns_per_packet: int = Field(default=16, ge=1, le=1 << 10)
    udp_profile_lidar: str = "LEGACY"
    lidar_origin_to_beam_origin_mm: FiniteFloat = 15.806
    beam_to_lidar_transform: Matrix | None = None
    lidar_to_sensor_transform: Matrix = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1]
    imu_to_sensor_transform: Matrix = [1, 0, 0, 6.253, 0, 1, 0, -11.775, 0, 0, 1, 7.645, 0, 0, 0, 1]
    extrinsic: Matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    pixel_shift_by_row: list[Annotated[int, Field(ge=-(1 << 12), le=1 << 12)]] = []
    prod_sn: int | str = 0

    @model_validator(mode="before")
    @classmethod
    def _flatten(cls, tree: Any) -> Any:
        if not isinstance(tree, dict):
            return tree
        sections = [value for _, value in sorted(tree.items()) if isinstance(value, dict)]
        flat: dict[str, Any] = {}
        for section in (*sections, tree):  # of the sensor's configuration before those of its data's format
            flat |= {
                name: value
                for name, value in section.items()
                if not (value is None or isinstance(value, dict))
            }
        columns = str(flat.get("lidar_mode", "")).partition("x")[0]
        return {"columns_per_frame": columns, **flat} if columns.isdecimal() else flat


class OusterSensor:
    """A sensor as its metadata describe it.

    Attributes:
        where: File or topic of the metadata.
        serial: Its serial number; 0 if that is not stated.
        packet_bytes: Size of its LiDAR packets.
        T_sensor_imu: Pose of its IMU in its own frame.
        T_sensor_lidar: Pose of its LiDAR in its own frame.
        T_base_sensor: Its pose as the user told Ouster's SDK; the identity if it was not told.
        shape: Its beams, and the columns of a turn.
        shifts: (beams,) columns by which the SDK moves each beam's, so that images are upright.
    """

    def __init__(self, text: str, *, where: str) -> None:
        """Read metadata.

        Raises:
            SourceError: They lack something or contradict each other, or the packets' format is not read.
        """
        found = parse_json(text, OusterMetadata, where=where)
        if (layout := _LAYOUTS.get(found.udp_profile_lidar)) is None:
            known = ", ".join(_LAYOUTS)
            raise SourceError(
                f"{where}: udp_profile_lidar {found.udp_profile_lidar} is not read; known are {known}"
            )
        self._found, self._layout = found, layout
        beams = len(found.beam_altitude_angles)
        if len(found.beam_azimuth_angles) != beams:
            raise SourceError(
                f"{where}: {beams} altitude angles, {len(found.beam_azimuth_angles)} azimuth angles"
            )
        self.where = where
        self.serial = int(found.prod_sn) if f"{found.prod_sn}".isdecimal() else 0
        self.T_sensor_imu = _pose_m(found.imu_to_sensor_transform, where=where)
        self.T_sensor_lidar = _pose_m(found.lidar_to_sensor_transform, where=where)
        self.T_base_sensor = _pose_m(found.extrinsic, where=where, unit_m=1.0)
        self.shape = beams, found.columns_per_frame
        self.shifts = found.pixel_shift_by_row
        self._is_legacy = found.udp_profile_lidar == "LEGACY"
        is_fusa = found.udp_profile_lidar.startswith("FUSA")
        column_bytes = (20 if self._is_legacy else 12) + beams * layout.pixel_bytes
        self._column = np.dtype(
            {
                "names": ["ns", "number", "status", "pixels"],
                "offsets": [0, 8, column_bytes - 4 if self._is_legacy else 10, 16 if self._is_legacy else 12],
                "formats": ["<u8", "<u2", "<u2", ("V" + str(layout.pixel_bytes), (beams,))],
                "itemsize": column_bytes,
            }
        )
        self._first = 0 if self._is_legacy else _HEADER_BYTES
        footer_bytes = 0 if self._is_legacy else _FOOTER_BYTES
        self.packet_bytes = self._first + found.columns_per_packet * column_bytes + footer_bytes
        self._head = np.dtype(
            {
                "names": ["frame", "serial", "ns"],
                "offsets": [10, 0, 0] if self._is_legacy else [4, 10, 32] if is_fusa else [2, 6, 32],
                "formats": ["<u4" if is_fusa else "<u2", "<u8", "<u8"],
                "itemsize": HEAD_BYTES,
            }
        )

    def heads(self, data: bytes | bytearray) -> tuple[NDArray[np.int64], Stamps, NDArray[np.int64]]:
        """Return the number of the turn, the time and the sensor's serial number of packets.

        Args:
            data: The first ``HEAD_BYTES`` of each.

        Returns:
            (N,) each; the serial number is 0 where the format has none, a damaged time is -1.
        """
        heads = np.frombuffer(data, self._head)
        serials = (
            np.zeros(len(heads), np.int64) if self._is_legacy else (heads["serial"] >> 8 & (1 << 40) - 1)
        )
        return heads["frame"].astype(np.int64), _signed(heads["ns"]), serials.astype(np.int64)

    def scan(self, packets: Sequence[memoryview], stamp_ns: int) -> Scan:
        """Return the returns of packets in the sensor's frame, with times and reflectivities.

        Args:
            packets: LiDAR packets of ``packet_bytes``.
            stamp_ns: Time of the scan.
        """
        data = np.frombuffer(b"".join(packets), np.uint8).reshape(len(packets), self.packet_bytes)
        end = self._first + self._found.columns_per_packet * self._column.itemsize
        columns = np.ascontiguousarray(data[:, self._first : end]).view(self._column).reshape(-1)
        columns = columns[(columns["status"] & 1 == 1) & (columns["number"] < self._found.columns_per_frame)]
        words = np.ascontiguousarray(columns["pixels"]).view(np.uint8)
        words = words.reshape(len(columns), self.shape[0], self._layout.pixel_bytes)
        returns = [self._return(words, k) for k in range(self._layout.returns)]
        return self.scan_of(returns, columns["number"], _signed(columns["ns"]), stamp_ns)

    def scan_of(
        self,
        returns: Sequence[tuple[NDArray[np.unsignedinteger], NDArray[np.unsignedinteger]]],
        numbers: NDArray[np.integer],
        columns_ns: Stamps,
        stamp_ns: int,
    ) -> Scan:
        """Return measured columns in the sensor's frame, with times and reflectivities.

        Args:
            returns: (N, beams) ranges in millimetres, 0 of none, and reflectivities of each return of a beam.
            numbers: (N,) number of each column within its turn.
            columns_ns: (N,) time of each.
            stamp_ns: Time of the scan.
        """
        times_s = ((columns_ns - stamp_ns) / NS_PER_S).astype(np.float32)
        parts = [self._points(*one, numbers.astype(np.intp), times_s) for one in returns]
        points, times, reflectivities = (np.concatenate(part) for part in zip(*parts, strict=True))
        return Scan(stamp_ns, points, times_s=times, intensities=reflectivities)

    def _return(self, words: NDArray[np.uint8], k: int) -> tuple[NDArray[np.uint32], NDArray[np.uint8]]:
        ranges = np.ascontiguousarray(words[:, :, 4 * k : 4 * k + 4]).view("<u4")[:, :, 0]
        ranges_mm = (ranges & (1 << self._layout.range_bits) - 1) * np.uint32(self._layout.unit_mm)
        return ranges_mm.astype(np.uint32), words[:, :, 4 * k + self._layout.reflectivity]

    def _points(
        self,
        ranges_mm: NDArray[np.unsignedinteger],
        reflectivities: NDArray[np.unsignedinteger],
        numbers: NDArray[np.intp],
        times_s: NDArray[np.float32],
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        column, beam = np.nonzero(ranges_mm)
        directions, offsets, apart_m = self._rays
        number = numbers[column]
        ranges_m = (ranges_mm[column, beam] / MM_PER_M - apart_m).astype(np.float32)
        points = directions[number * ranges_mm.shape[1] + beam] * ranges_m[:, None] + offsets[number]
        return points, times_s[column], reflectivities[column, beam].astype(np.float32)

    @cached_property
    def _rays(self) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
        """Directions of every column's beams, where each column's beams start, and how far that is.

        They start at a place that turns with the lidar, and ranges are counted from its axis.
        """
        found = self._found
        columns = found.columns_per_frame
        turned = 2.0 * np.pi * (1.0 - np.arange(columns) / columns)
        azimuths = turned[:, None] - np.radians(found.beam_azimuth_angles)
        altitudes = np.broadcast_to(np.radians(found.beam_altitude_angles), azimuths.shape)
        flat = np.cos(altitudes)
        directions = np.stack([flat * np.cos(azimuths), flat * np.sin(azimuths), np.sin(altitudes)], axis=2)
        out_mm, up_mm = found.lidar_origin_to_beam_origin_mm, 0.0
        if found.beam_to_lidar_transform is not None:
            out_mm, up_mm = found.beam_to_lidar_transform[3], found.beam_to_lidar_transform[11]
        origins = np.stack(
            [out_mm * np.cos(turned), out_mm * np.sin(turned), np.full(columns, up_mm)], axis=1
        )
        R_sensor_lidar, place = self.T_sensor_lidar[:3, :3], self.T_sensor_lidar[:3, 3]
        return (
            (directions.reshape(-1, 3) @ R_sensor_lidar.T).astype(np.float32),
            (origins / MM_PER_M @ R_sensor_lidar.T + place).astype(np.float32),
            float(np.hypot(out_mm, up_mm)) / MM_PER_M,
        )


def is_imu(packet: memoryview) -> bool:
    """Return whether a packet is one of inertial readings, by its size and type."""
    samples, rest = divmod(len(packet) - _HEADER_BYTES - _NMEA_BYTES - _FOOTER_BYTES, _IMU_SAMPLE.itemsize)
    return len(packet) == _IMU_BYTES or (rest == 0 and 0 < samples <= 64 and packet[0] == _IMU_TYPE)


def imu_readings(packet: memoryview) -> Iterator[tuple[int, Array, Array]]:
    """Yield the time, the angular velocity (rad/s) and the acceleration (m/s²) of each reading of a packet.

    The older kind of packets has one reading, in °/s and g; ACCEL32_GYRO32_NMEA several, in these units.
    """
    if len(packet) == _IMU_BYTES:
        reading = np.frombuffer(packet, _IMU)[0]
        rates_radps = np.radians(reading["rate"].astype(np.float64))
        yield int(reading["ns"]), rates_radps, reading["acceleration"].astype(np.float64) * GRAVITY_MPS2
        return
    for reading in np.frombuffer(packet[_HEADER_BYTES + _NMEA_BYTES : -_FOOTER_BYTES], _IMU_SAMPLE):
        if reading["status"] & 1:
            rates_radps, acceleration_mps2 = (
                reading[name].astype(np.float64) for name in ("rate", "acceleration")
            )
            yield int(reading["ns"]), rates_radps, acceleration_mps2


def metadata_beside(log: Path) -> tuple[list[OusterSensor], list[str]]:
    """Return the sensors of the metadata files beside a log or in it, those of its name first; problems."""
    stem = log.resolve().stem
    folders = [log, log.parent] if log.is_dir() else [log.parent]
    files = [(file.name.startswith(stem), file) for folder in folders for file in folder.glob("*.json")]
    found, problems = [], []
    for _, file in sorted(files, key=lambda one: (not one[0], one[1]))[:_MOST_TRIED]:
        with suppress(OSError, DataError):
            if file.stat().st_size > MIB or _KEY not in (text := read_text(file)):
                continue
            try:
                found.append(OusterSensor(text, where=file.name))
            except SourceError as error:
                problems.append(f"{error}")
    return found, problems


def packet_sizes() -> frozenset[int]:
    """Return the sizes of LiDAR packets of sensors of 16 to 128 beams."""
    return frozenset(
        16 * (20 + beams * layout.pixel_bytes)
        if name == "LEGACY"
        else 64 + 16 * (12 + beams * layout.pixel_bytes)
        for name, layout in _LAYOUTS.items()
        for beams in (16, 32, 64, 128)
    )


def _pose_m(numbers: Sequence[float], *, where: str, unit_m: float = 1.0 / MM_PER_M) -> Transform:
    T = np.array(numbers, np.float64).reshape(4, 4)
    T[:3, 3] *= unit_m
    if not is_rigid(T):
        raise SourceError(f"{where}: a transform that is no rigid motion")
    return T


def _signed(stamps: NDArray[np.uint64]) -> Stamps:
    """Return times as int64; -1 for those after ``LATEST_NS``, which are damaged."""
    return np.where(stamps < LATEST_NS, stamps.astype(np.int64), -1)
