"""PCD: the Point Cloud Library's files (Rusu & Cousins 2011), ascii, binary and compressed."""

from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError
from mapper.sources.cloud_files.parsing import Columns, parse_rows, refusing_damage

_MOST_LINES = 100


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


def _read(stream: BinaryIO) -> tuple[NDArray[np.void], int]:
    """Return the points, and how many there should be."""
    from pypcd4 import Encoding, MetaData, PointCloud

    header = MetaData.parse_header(_header_lines(stream))
    if header.data == Encoding.ASCII and header.points > 0:  # pypcd4 allows one blank between numbers only
        return parse_rows(stream, header.build_dtype()), header.points
    stream.seek(0)
    return PointCloud.from_fileobj(stream).pc_data, header.points


def _header_lines(stream: BinaryIO) -> list[str]:
    lines: list[str] = []
    for line in islice(stream, _MOST_LINES):
        lines.append(line.decode(errors="replace").strip())
        if lines[-1].startswith("DATA"):
            break
    return lines
