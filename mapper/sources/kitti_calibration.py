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


def matrix_of(path: Path, name: str, *shape: int) -> Array:
    """Return the matrix of a line, which has to be there; arguments as of :func:`read_matrix`.

    Raises:
        SourceError: As ``read_matrix``, or there is no such file or line.
    """
    matrix = read_matrix(path, name, *shape)
    if matrix is None:
        missing = f"line {name}:" if path.is_file() else "such file"
        raise SourceError(f"{path}: no {missing}; want the calibration that comes with KITTI's recordings")
    return matrix


def offset_of(projection: Array) -> Transform:
    """Return T_camera_first of a rectified camera, whose 3×4 projection is of the first one's points."""
    offset = np.linalg.solve(projection[:, :3], projection[:, 3])
    return transform(np.eye(3), offset.astype(np.float64))


def rectification(path: Path) -> Transform:
    """Return the rotation R_rect_00 of a raw recording's cameras; the identity where it is not stated.

    Raises:
        SourceError: It is no rotation.
    """
    R = read_matrix(path, "R_rect_00", 3, 3)
    return np.eye(4) if R is None else rigid_motion(np.column_stack([R, np.zeros(3)]), f"{path}: R_rect_00")


def pose_beside(drive: Path, name: str) -> Transform | None:
    """Return the pose of a file of R and T, such as ``calib_velo_to_cam.txt`` of T_first_lidar.

    Args:
        drive: Folder of a raw drive.
        name: The file's name, in the folder or beside it; None is returned without it.

    Raises:
        SourceError: It lacks R or T, or they are no rigid motion.
    """
    for path in (drive / name, drive.resolve().parent / name):
        if path.is_file():
            pose = np.column_stack([matrix_of(path, "R", 3, 3), matrix_of(path, "T", 3)])
            return rigid_motion(pose, f"{path}")
    return None


def rigid_motion(matrix: Array, where: str) -> Transform:
    """Return the rigid motion that a 3×4 matrix is.

    Raises:
        SourceError: It is none.
    """
    R = nearest_rotation(matrix[:, :3]) if np.isfinite(matrix).all() else np.full((3, 3), np.nan)
    if not np.abs(R - matrix[:, :3]).max() < ROUNDING:
        raise SourceError(f"{where}: not a rigid motion; want the 3×4 pose of the LiDAR or a camera")
    return transform(R, matrix[:, 3])
