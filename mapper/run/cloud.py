"""Coloured cloud of a run, read back from its PLY file."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError
from mapper.core.frames import Cloud
from mapper.core.geometry import FARTHEST_M
from mapper.sources.cloud_files.parsing import Columns
from mapper.sources.cloud_files.ply import read_ply


def read_cloud(path: Path) -> Cloud:
    """Return the cloud of a PLY file with colours.

    Raises:
        FrameError: The file cannot be read, or is not as a run's clouds are.
    """
    try:
        columns = read_ply(path)
    except OSError as error:
        raise FrameError(f"{path}: cannot be read: {error.strerror}") from None
    points = _columns(columns, ("x", "y", "z"), np.float32, path)
    if not -FARTHEST_M <= points.min(initial=0.0) <= points.max(initial=0.0) <= FARTHEST_M:
        first = np.flatnonzero(~(np.abs(points) <= FARTHEST_M).all(axis=1))[0]
        raise FrameError(f"{path}: point {first} is at {points[first]}, want finite metres")
    colors = _columns(columns, ("red", "green", "blue"), np.uint8, path)
    scalars = (
        _columns(columns, (name,), np.float32, path).ravel() if name in columns else None
        for name in ("intensity", "time")
    )
    return Cloud(points, colors, *scalars)


def _columns(
    columns: Columns, names: tuple[str, ...], kind: type[np.float32 | np.uint8], path: Path
) -> NDArray[Any]:
    for name in names:
        if name not in columns or not np.can_cast(columns[name].dtype, kind, "equiv"):
            raise FrameError(f"{path}: no property {name} of {np.dtype(kind)}, as a run's clouds have")
    return np.column_stack([columns[name] for name in names]).astype(kind, copy=False)
