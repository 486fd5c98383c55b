"""LAS and LAZ: the ASPRS's exchange format of surveys."""

from pathlib import Path

import numpy as np

from mapper.errors import FrameError
from mapper.sources.cloud_files.raw import Columns, refusing_damage

_EXTRAS = ("gps_time", "red", "green", "blue")


def read_las(path: Path) -> Columns:
    """Read coordinates with the file's scale and offset applied, in float64, and times and colours if any.

    Raises:
        FrameError: It is malformed or cut.
    """
    import laspy

    with path.open("rb") as stream, refusing_damage(path, what="LAS"):
        reader = laspy.open(stream, closefd=False)
        header = reader.header
        end = header.offset_to_point_data + header.point_count * header.point_format.size
        if not header.are_points_compressed and (size := path.stat().st_size) < end:
            raise FrameError(f"{path}: {size} bytes, but the header says {end} or more; was the file cut?")
        cloud = reader.read()
        columns = {"x": cloud.x, "y": cloud.y, "z": cloud.z}
        columns |= {name: cloud[name] for name in _EXTRAS if name in header.point_format.dimension_names}
    return {name: np.asarray(values) for name, values in columns.items()}
