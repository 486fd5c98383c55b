"""LAS and LAZ: the ASPRS's exchange format of surveys."""

from pathlib import Path

import numpy as np

from mapper.core.errors import FrameError
from mapper.sources.cloud_files.parsing import Columns, refusing_damage

_EXTRAS = ("gps_time", "red", "green", "blue")
_RECORDS_AT = 100  # a uint32: how many records of variable length follow the header (LAS 1.0 to 1.4)
_RECORD_BYTES = 54  # of each one's own header


def read_las(path: Path) -> Columns:
    """Read coordinates with the file's scale and offset applied, in float64, and times and colours if any.

    Raises:
        FrameError: It is malformed or cut.
    """
    import laspy

    size = path.stat().st_size
    with path.open("rb") as stream, refusing_damage(path, what="LAS"):
        records = int.from_bytes(stream.read(_RECORDS_AT + 4)[_RECORDS_AT:], "little")
        if records * _RECORD_BYTES > size:  # laspy would make as many empty ones
            raise FrameError(f"{path}: {size} bytes, but the header says {records} VLRs; is it damaged?")
        stream.seek(0)
        reader = laspy.open(stream, closefd=False, read_evlrs=False)
        header = reader.header
        end = header.offset_to_point_data + header.point_count * header.point_format.size
        if size < end and not header.are_points_compressed:
            raise FrameError(f"{path}: {size} bytes, but the header says {end} or more; was the file cut?")
        cloud = reader.read()
        columns = {"x": cloud.x, "y": cloud.y, "z": cloud.z}
        columns |= {name: cloud[name] for name in _EXTRAS if name in header.point_format.dimension_names}
    return {name: np.asarray(values) for name, values in columns.items()}
