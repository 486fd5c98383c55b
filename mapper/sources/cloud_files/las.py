"""LAS and LAZ: the ASPRS's exchange format of surveys."""

import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mapper.core.errors import FrameError
from mapper.sources.cloud_files.parsing import MOST_BYTES, Columns, refusing_damage

_EXTRAS = ("gps_time", "red", "green", "blue")
_RECORDS_AT = 100  # a uint32: how many records of variable length follow the header (LAS 1.0 to 1.4)
_RECORD_BYTES = 54  # of each one's own header
_COORDINATE_BYTES = 3 * 8  # of a point's x, y and z once they are scaled
_MOST_POINTS_PER_BYTE = 200  # of LAZ: a million times the same point is packed into 7 kB
_TABLE_PLACE = struct.Struct("<q")  # where the chunk table of compressed points lies; −1: the file's end says
_TABLE_HEADER = struct.Struct("<II")  # version, number of chunks


def read_las(path: Path) -> Columns:
    """Read coordinates with the file's scale and offset applied, in float64, and times and colours if any.

    Raises:
        FrameError: It is malformed or cut, or announces more points than are read.
    """
    import laspy

    size = path.stat().st_size
    with path.open("rb") as stream, refusing_damage(path, what="LAS"):
        records = int.from_bytes(stream.read(_RECORDS_AT + 4)[_RECORDS_AT:], "little")
        if records * _RECORD_BYTES > size:  # laspy would make as many empty ones
            raise FrameError(f"{path}: {size} bytes, but the header says {records} VLRs; is it damaged?")
        stream.seek(0)
        # Not in parallel: that would trust the chunks' lengths, and other threads read other files meanwhile.
        backend = laspy.LazBackend.Lazrs
        reader = laspy.open(stream, closefd=False, read_evlrs=False, laz_backend=backend)
        header = reader.header
        end = header.offset_to_point_data + header.point_count * header.point_format.size
        if size < end and not header.are_points_compressed:
            raise FrameError(f"{path}: {size} bytes, but the header says {end} or more; was the file cut?")
        if header.point_count * (header.point_format.size + _COORDINATE_BYTES) > MOST_BYTES:
            raise FrameError(
                f"{path}: {header.point_count} points, which take more than {MOST_BYTES} bytes; split it"
            )
        if header.are_points_compressed:
            if header.point_count > _MOST_POINTS_PER_BYTE * size:
                raise FrameError(f"{path}: {size} bytes, but the header says {header.point_count} points")
            _check_chunks(stream, start=header.offset_to_point_data, size=size, points=header.point_count)
        cloud = reader.read()
        columns = {"x": cloud.x, "y": cloud.y, "z": cloud.z}
        columns |= {name: cloud[name] for name in _EXTRAS if name in header.point_format.dimension_names}
    return {name: np.asarray(values) for name, values in columns.items()}


def _check_chunks(stream: BinaryIO, *, start: int, size: int, points: int) -> None:
    """Refuse a table of more chunks than points: lazrs makes room for all, and ends the process if it cannot.

    Args:
        stream: The file; it is left where it was.
        start: Where its points begin.
        size: Its length, bytes.
        points: How many points it announces.

    Raises:
        ValueError: The table lies elsewhere than after the points, or announces too many chunks.
    """
    before = stream.tell()
    stream.seek(start)
    (place,) = _TABLE_PLACE.unpack(stream.read(_TABLE_PLACE.size))
    if place == -1:  # the file was written without ever going back
        stream.seek(size - _TABLE_PLACE.size)
        (place,) = _TABLE_PLACE.unpack(stream.read())
    if not start <= place <= size - _TABLE_HEADER.size:
        raise ValueError(f"its chunk table is said to lie at byte {place} of {size}")
    stream.seek(place)
    _, chunks = _TABLE_HEADER.unpack(stream.read(_TABLE_HEADER.size))
    if chunks > points:
        raise ValueError(f"a table of {chunks} chunks for {points} points")
    stream.seek(before)
