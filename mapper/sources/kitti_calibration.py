"""Calibration files of KITTI: a line of numbers for each matrix, ``P2: …`` (Geiger et al. 2013, §II)."""

from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import Array, Transform, nearest_rotation, transform
from mapper.sources.text import ROUNDING, parse_numbers, rows


def read_matrix(path: Path, name: str, *shape: int) -> Array | None:
    """Return the matrix of a line; None without the file or the line.

    Args:
        path: Calibration file.
        name: Name at the beginning of the line.
        shape: Rows and columns.

    Raises:
        SourceError: The file cannot be read, or the line has other than the matrix's numbers.
    """
    if not path.is_file():
        return None
    for number, words in rows(path):
        if words[0].rstrip(":") == name:
            where, count = f"{path}:{number}", int(np.prod(shape))
            if len(words) != count + 1:
                of = "×".join(map(str, shape))
                raise SourceError(f"{where}: {len(words) - 1} numbers, want {count}: the {of} matrix {name}")
            return parse_numbers(words[1:], where=where).reshape(shape)
    return None


def rigid_motion(matrix: Array, where: str) -> Transform:
    """Return the rigid motion that a 3×4 matrix is.

    Raises:
        SourceError: It is none.
    """
    R = nearest_rotation(matrix[:, :3]) if np.isfinite(matrix).all() else np.full((3, 3), np.nan)
    if not np.abs(R - matrix[:, :3]).max() < ROUNDING:
        raise SourceError(f"{where}: not a rigid motion; want the LiDAR's 3×4 pose in the camera")
    return transform(R, matrix[:, 3])
