"""PCD: the Point Cloud Library's files (Rusu & Cousins 2011), ascii, binary and compressed."""

from pathlib import Path

import numpy as np

from mapper.errors import FrameError
from mapper.sources.cloud_files.raw import Columns


def read_pcd(path: Path) -> Columns:
    """Read the fields of a PCD file.

    Raises:
        FrameError: It is malformed, or holds another number of points than its header says.
    """
    from pypcd4 import PointCloud

    with path.open("rb") as stream:
        try:
            cloud = PointCloud.from_fileobj(stream)
        except Exception as error:  # damaged bytes raise whatever the line that met them raises
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise FrameError(f"{path}: not a sound PCD file: {reason}") from None
    fields = np.atleast_1d(cloud.pc_data)
    if len(fields) != cloud.metadata.points:
        raise FrameError(
            f"{path}: {len(fields)} points, but the header says {cloud.metadata.points}; was the file cut?"
        )
    return {name: fields[name] for name in fields.dtype.names or ()}
