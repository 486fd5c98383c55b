"""Readers of cloud files: one point cloud each, in the usual formats."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from mapper.core.errors import FrameError
from mapper.sources.cloud_files.bare import EMPTY, read_bin, read_npy, read_text, why_no_points
from mapper.sources.cloud_files.las import read_las
from mapper.sources.cloud_files.parsing import MOST_BYTES, Columns
from mapper.sources.cloud_files.pcd import read_pcd
from mapper.sources.cloud_files.ply import read_ply
from mapper.sources.cloud_files.raw import RawCloud, cloud_from

__all__ = ["EMPTY", "ENDINGS", "RawCloud", "read_cloud", "why_no_points"]

_READERS: Mapping[str, Callable[[Path], Columns]] = {
    ".bin": read_bin,
    ".pcd": read_pcd,
    ".ply": read_ply,
    **dict.fromkeys((".xyz", ".xyzi", ".xyzrgb", ".asc", ".pts", ".txt", ".csv"), read_text),
    ".npy": read_npy,
    ".las": read_las,
    ".laz": read_las,
}
ENDINGS = tuple(_READERS)


def read_cloud(
    path: Path,
    *,
    scale: float | None = None,
    bin_columns: int | None = None,
    rows: tuple[int, int] | None = None,
) -> RawCloud:
    """Return the cloud of a file, without missing returns.

    Args:
        path: A file; its ending determines the format.
        scale: Metres per unit of the file. None is 1, and refuses what looks like millimetres.
        bin_columns: Numbers of a record in a .bin file. None is KITTI's four, and refuses others.
        rows: First point of a LAS file that is read, and the one after the last; None is the whole file.

    Raises:
        FrameError: The file cannot be read or is damaged, holds too few points, or its points are not in
            metres around the sensor.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is read_bin:
        reader = partial(read_bin, columns=bin_columns)
    if reader is None:
        raise FrameError(f"{path}: not the ending of a cloud; want one of {' '.join(ENDINGS)}")
    try:
        size = path.stat().st_size
        if rows is not None:
            return cloud_from(read_las(path, rows), path=path, scale=scale)
        if size > MOST_BYTES:
            raise FrameError(f"{path}: {size} bytes, want {MOST_BYTES} at most; split it")
        return cloud_from(reader(path), path=path, scale=scale)
    except OSError as error:
        raise FrameError(f"{path}: cannot be read: {error.strerror or error}") from None
    except MemoryError:
        raise FrameError(f"{path}: does not fit into memory; split it") from None
