"""Reading of trajectories: TUM text, MulRan's, or KITTI's with or without a list of times."""

from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.trajectory import Trajectory
from mapper.sources.text import parse_stamp, rows
from mapper.sources.trajectory_files import is_mulran, read_kitti, read_mulran, read_tum

_KITTI_COLUMNS = 12


def is_kitti(path: Path) -> bool:
    """Return whether a file begins with a row-major 3×4 pose, which has no stamp.

    Raises:
        SourceError: The file cannot be read.
    """
    try:
        _, words = next(rows(path), (0, []))
    except SourceError as error:
        raise SourceError(f"{error}; want poses as TUM or KITTI text") from None
    return len(words) == _KITTI_COLUMNS


def read_poses(path: Path, *, times: Path | None = None) -> Trajectory:
    """Return a trajectory from TUM, EuRoC, MulRan or KITTI text, whichever it is.

    Args:
        path: The poses.
        times: Seconds, one a line, of KITTI's poses; without it pose i gets i nanoseconds, which only
            orders them.

    Raises:
        SourceError: A file cannot be read, or a time is no number.
        DataError: A line is malformed, or there are more or fewer times than poses.
    """
    if not is_kitti(path):
        return read_mulran(path) if is_mulran(path) else read_tum(path)
    if times is None:
        return read_kitti(path)
    stamps = [parse_stamp(words[0], where=f"{times}:{number}") for number, words in rows(times)]
    return read_kitti(path, np.array(stamps, dtype=np.int64))
