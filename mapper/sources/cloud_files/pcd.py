"""PCD: the Point Cloud Library's files (Rusu & Cousins 2011), ascii, binary and compressed."""

import os
import struct
from contextlib import suppress
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError
from mapper.runtime.atomic import write_bytes
from mapper.runtime.regular_files import MOST_UNPACKED_RATIO
from mapper.sources.cloud_files.parsing import HEADER_LINES, MOST_BYTES, Columns, parse_rows, refusing_damage

_MOST_VALUES = 10_000  # of a point: histograms of features have some hundreds
_SIZES = struct.Struct("<II")  # of compressed points, before they are unpacked and after


def read_pcd(path: Path) -> Columns:
    """Read the fields of a PCD file.

    Raises:
        FrameError: It is malformed, or holds another number of points than its header says.
    """
    with path.open("rb") as stream, refusing_damage(path, what="PCD"):
        fields, stated = _read(stream)
    if len(fields) != stated:
        raise FrameError(f"{path}: {len(fields)} points, but the header says {stated}; was the file cut?")
    return {name: fields[name] for name in fields.dtype.names or ()}


def viewpoint_note(path: Path) -> list[str]:
    """Return a note on the pose of the sensor that a PCD file states, if it is another than identity."""
    with path.open("rb") as stream:
        line = next((line for line in _header_lines(stream) if line.startswith("VIEWPOINT")), "")
    with suppress(ValueError):
        if [float(word) for word in line.split()[1:]] in ([], [0, 0, 0, 1, 0, 0, 0]):
            return []
    return [f"{path.name}: its {line} is not used; points are taken to be around the sensor"]


def _read(stream: BinaryIO) -> tuple[NDArray[np.void], int]:
    """Return the points, and how many there should be."""
    from pypcd4 import Encoding, MetaData, PointCloud

    header = MetaData.parse_header(_header_lines(stream))
    if sum(header.count) > _MOST_VALUES:  # pypcd4 gives each a name
        raise ValueError(f"{sum(header.count)} values a point, want {_MOST_VALUES} at most")
    if header.data == Encoding.ASCII and header.points > 0:  # pypcd4 allows one blank between numbers only
        return parse_rows(stream, header.build_dtype()), header.points
    _check_size(stream, header, is_compressed=header.data == Encoding.BINARY_COMPRESSED)
    stream.seek(0)
    return PointCloud.from_fileobj(stream).pc_data, header.points


def _check_size(stream: BinaryIO, header: Any, *, is_compressed: bool) -> None:
    """Refuse a header that announces more bytes than follow it, before room is made for them.

    Raises:
        ValueError: It does, or the compressed points cannot be unpacked to as many.
    """
    want = header.points * sum(size * count for size, count in zip(header.size, header.count, strict=True))
    left = os.fstat(stream.fileno()).st_size - stream.tell()
    if is_compressed and header.points:
        packed, unpacked = _SIZES.unpack(stream.read(_SIZES.size).ljust(_SIZES.size, b"\0"))
        left -= _SIZES.size
        if unpacked != want or packed > left:
            raise ValueError(
                f"{left} bytes, of which {packed} unpack to {unpacked}, but the header says {header.points} "
                f"points of {want} bytes; was it cut?"
            )
        if unpacked > min(MOST_UNPACKED_RATIO * packed, MOST_BYTES):
            raise ValueError(f"{packed} bytes that unpack to {unpacked}, which they cannot or must not")
    elif want > left:
        raise ValueError(
            f"{left} bytes, but the header says {header.points} points of {want} bytes; was it cut?"
        )


def _header_lines(stream: BinaryIO) -> list[str]:
    lines: list[str] = []
    for line in islice(stream, HEADER_LINES):
        lines.append(line.decode(errors="replace").strip())
        if lines[-1].startswith("DATA"):
            break
    return lines


def write_pcd(path: Path, columns: Columns) -> None:
    """Write points with colours as binary PCD, atomically.

    Args:
        path: File to write.
        columns: x, y, z in metres; red, green, blue, uint8, which become PCL's "rgb"; others stay fields.
    """
    from pypcd4 import PointCloud

    red, green, blue = (columns[name].astype(np.uint32) for name in ("red", "green", "blue"))
    fields = {axis: columns[axis] for axis in "xyz"}
    fields["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)  # a float's bits, as PCL has it
    fields |= {name: columns[name] for name in columns if name not in ("x", "y", "z", "red", "green", "blue")}
    data = BytesIO()
    PointCloud.from_points(
        list(fields.values()), list(fields), [each.dtype for each in fields.values()]
    ).save(data)
    write_bytes(path, data.getvalue())
