"""LAS and LAZ: the ASPRS's exchange format of surveys."""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from stat import S_ISREG
from typing import Any, BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError
from mapper.core.geometry import Array
from mapper.core.timebase import GPS_EPOCH_S
from mapper.core.units import MIB
from mapper.runtime.atomic import write_bytes
from mapper.runtime.regular_files import MOST_UNPACKED_RATIO
from mapper.runtime.worker_process import call_isolated
from mapper.sources.cloud_files.parsing import MOST_BYTES, Column, Columns, refusing_damage

LAS_ENDINGS = (".las", ".laz")
_COLOURS = ("red", "green", "blue")
_TIME, _TIME_BYTES = "gps_time", 8
_EXTRAS = (_TIME, "intensity", *_COLOURS)
_ADJUSTED, _ADJUSTED_S = 1, 1_000_000_000
"""Bit 0 of the header's global encoding: times are GPS time less 10⁹ s, else of the week (LAS 1.4)."""
_DATE_AT, _DATE_BYTES = 90, 4  # day and year
_RECORDS = struct.Struct("<100xI")  # how many records of variable length follow the header (LAS 1.0 to 1.4)
_RECORD_BYTES = 54  # of each one's own header
_COORDINATES = struct.Struct("<3d")  # a point's x, y and z once they are scaled
_LAZ_COPIES = 3  # the packed points' layers, all points as records, and their coordinates
_LAZ_BUFFERS_BYTES = 256 * MIB
_CHUNK_POINTS = 1_000_000
_WKT_RECORD = "LASF_Projection", 2112, "OGC WKT"
_SCALE_M = 1e-4  # of coordinates; wider where 32 bits do not hold them
_FULL_RANGE = 257  # 255 becomes 65535: LAS has colours of 16 bits

R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class LasExtent:
    """Extent of a file's points.

    Attributes:
        low: Least x, y, z by the header, metres.
        high: Largest x, y, z.
        first_s: Time of the first point in the file, as of :func:`read_las`.
        last_s: Time of the last one.
        points: Their number.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    first_s: float
    last_s: float
    points: int


def read_las(path: Path, rows: tuple[int, int] | None = None) -> Columns:
    """Read coordinates with the file's scale and offset applied, in float64, and times and colours if any.

    Times are seconds of Unix time if the header says that they are GPS time less 10⁹ s, else as they are:
    seconds of the GPS week. Compressed points are read in another process: lazrs aborts if it cannot allocate
    what a damaged file announces, be it its table of chunks or a chunk's layers.

    Args:
        path: The file.
        rows: First point that is read, and the one after the last; None reads all.

    Raises:
        FrameError: It is malformed or cut, or announces more points than are read.
    """
    return _read(path, partial(_columns, rows=rows), count=None if rows is None else rows[1] - rows[0])


def las_extent(path: Path) -> LasExtent | None:
    """Return the extent of a file's points, of which two are read; None if it has none, or no times.

    Raises:
        FrameError: As :func:`read_las`.
    """
    return _read(path, _extent, count=2)


def first_time_s(path: Path) -> float | None:
    """Return the time of the first point, which alone is read; None if the file has none, or no times.

    Raises:
        FrameError: As :func:`read_las`.
    """
    times = _read(path, partial(_columns, rows=(0, 1)), count=1).get(_TIME)
    return None if times is None or not len(times) else float(times[0])


def read_times_s(path: Path) -> Array:
    """Return the (N,) times of all points of a file that has them.

    Raises:
        FrameError: As :func:`read_las`.
    """
    return _read(path, _times, count=0)


def _read(path: Path, job: Callable[[Any], R], *, count: int | None) -> R:
    """Return what a job makes of laspy's reader.

    Args:
        path: The file.
        job: A function that can be pickled.
        count: Number of points that it makes columns of; None is all, 0 every point's time alone.
    """
    status = path.stat()
    if not S_ISREG(status.st_mode):  # opening a pipe waits for its writer
        raise FrameError(f"{path}: no regular file")
    size = status.st_size
    with path.open("rb") as stream, refusing_damage(path, what="LAS"):
        (records,) = _RECORDS.unpack(stream.read(_RECORDS.size))
        if records * _RECORD_BYTES > size:  # laspy would make as many empty ones
            raise FrameError(f"{path}: {size} bytes, but the header says {records} VLRs; is it damaged?")
        reader = _opened(stream)
        points, point_bytes = reader.header.point_count, reader.header.point_format.size
        whole = points if count is None else min(count, points)
        unpacked_bytes = whole * (point_bytes + _COORDINATES.size) + points * _TIME_BYTES * (count == 0)
        if unpacked_bytes > MOST_BYTES:
            raise FrameError(f"{path}: {points} points, which take more than {MOST_BYTES} bytes; split it")
        if reader.header.are_points_compressed:
            if points > MOST_UNPACKED_RATIO * size:  # a million times the same point takes 7 kB
                raise FrameError(f"{path}: {size} bytes, but the header says {points} points")
            memory_bytes = size + _LAZ_COPIES * unpacked_bytes + _LAZ_BUFFERS_BYTES
            return call_isolated(partial(_read_laz, path, job), memory_bytes=memory_bytes)
        end = reader.header.offset_to_point_data + points * point_bytes
        if size < end:
            raise FrameError(f"{path}: {size} bytes, but the header says {end} or more; was the file cut?")
        return job(reader)


def _read_laz(path: Path, job: Callable[[Any], R]) -> R:
    with path.open("rb") as stream, refusing_damage(path, what="LAS"):
        return job(_opened(stream))


def _opened(stream: BinaryIO) -> Any:
    """Return laspy's reader; not the parallel one, as other threads read other files meanwhile."""
    import laspy

    stream.seek(0)
    return laspy.open(stream, closefd=False, read_evlrs=False, laz_backend=laspy.LazBackend.Lazrs)


def _columns(reader: Any, rows: tuple[int, int] | None = None) -> Columns:
    if rows is None:
        cloud = reader.read()
    else:
        if rows[0] > 0:
            reader.seek(rows[0])
        cloud = reader.read_points(rows[1] - rows[0])
    columns = {"x": cloud.x, "y": cloud.y, "z": cloud.z}
    columns |= {name: cloud[name] for name in _EXTRAS if name in cloud.point_format.dimension_names}
    columns = {name: np.asarray(values) for name, values in columns.items()}
    if _TIME in columns:
        columns[_TIME] = columns[_TIME] + _zero_s(reader)
    return columns


def _extent(reader: Any) -> LasExtent | None:
    header = reader.header
    if not header.point_count or _TIME not in header.point_format.dimension_names:
        return None

    def time_s(row: int) -> float:
        reader.seek(row)
        return float(reader.read_points(1)[_TIME][0]) + _zero_s(reader)

    low, high = tuple(header.mins.tolist()), tuple(header.maxs.tolist())
    return LasExtent(low, high, time_s(0), time_s(header.point_count - 1), header.point_count)


def _times(reader: Any) -> Array:
    parts = [np.array(points[_TIME], np.float64) for points in reader.chunk_iterator(_CHUNK_POINTS)]
    return np.concatenate([np.empty(0), *parts]) + _zero_s(reader)


def _zero_s(reader: Any) -> float:
    """Return the Unix time of the file's time 0, seconds; 0 of times within a week."""
    is_dated = reader.header.global_encoding.gps_time_type == _ADJUSTED
    return GPS_EPOCH_S + _ADJUSTED_S if is_dated else 0.0


def _sixteen_bits(intensities: Column) -> NDArray[np.uint16]:
    most = np.iinfo(np.uint16).max
    largest = float(intensities.max(initial=0.0))
    scale = most / max(largest, 1.0) if largest <= 1.0 or largest > most else 1.0
    scaled: NDArray[np.uint16] = np.rint(np.clip(intensities, 0.0, None) * scale).astype(np.uint16)
    return scaled


def write_las(path: Path, columns: Columns, *, wkt: str | None = None) -> None:
    """Write points with colours as LAS, atomically; compressed if the name ends in ".laz".

    Args:
        path: File to write.
        columns: x, y, z in metres, which are rounded to 0.1 mm; red, green, blue, uint8; intensity, scaled to
            the 16 bits of LAS where it exceeds them or is a share of 1; others become extra dimensions.
        wkt: Coordinate reference system as WKT 1, which takes LAS 1.4; None writes LAS 1.2 without one.
    """
    import laspy

    points = np.column_stack([columns[axis] for axis in "xyz"]).astype(np.float64)
    low, high = points.min(axis=0, initial=0.0), points.max(axis=0, initial=0.0)
    header = laspy.LasHeader(point_format=2, version="1.2")
    if wkt is not None:
        header = laspy.LasHeader(point_format=7, version="1.4")
        header.global_encoding.wkt = True
        header.vlrs.append(laspy.VLR(*_WKT_RECORD, record_data=wkt.encode() + b"\0"))
    header.generating_software = "mapper"
    header.offsets = np.floor(low)
    header.scales = np.maximum(_SCALE_M, (high - low + 1.0) / 2**31)
    extra = [name for name in columns if name not in ("x", "y", "z", "intensity", *_COLOURS)]
    header.add_extra_dims([laspy.ExtraBytesParams(name, columns[name].dtype) for name in extra])
    cloud = laspy.LasData(header)
    cloud.xyz = points
    for name in extra:
        cloud[name] = columns[name]
    if "intensity" in columns:
        cloud["intensity"] = _sixteen_bits(columns["intensity"])
    for name in _COLOURS:
        cloud[name] = columns[name].astype(np.uint16) * _FULL_RANGE
    data = BytesIO()
    is_packed = path.suffix.lower() == ".laz"
    cloud.write(data, do_compress=is_packed, laz_backend=laspy.LazBackend.Lazrs)
    data.seek(_DATE_AT)
    data.write(bytes(_DATE_BYTES))  # laspy writes today's; without one the same points are the same bytes
    write_bytes(path, data.getvalue())
