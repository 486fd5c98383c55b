"""PCD: the Point Cloud Library's files (Rusu & Cousins 2011), ascii, binary and compressed."""

from pathlib import Path

import numpy as np

from mapper.errors import FrameError
from mapper.sources.cloud_files.raw import Columns, refusing_damage


def read_pcd(path: Path) -> Columns:
    """Read the fields of a PCD file.

    Raises:
        FrameError: It is malformed, or holds another number of points than its header says.
    """
    from pypcd4 import PointCloud

    with path.open("rb") as stream, refusing_damage(path, what="PCD"):
        cloud = PointCloud.from_fileobj(stream)
    fields = np.atleast_1d(cloud.pc_data)
    if len(fields) != cloud.metadata.points:
        raise FrameError(
            f"{path}: {len(fields)} points, but the header says {cloud.metadata.points}; was the file cut?"
        )
    return {name: fields[name] for name in fields.dtype.names or ()}
