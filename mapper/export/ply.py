"""Coloured clouds as binary PLY (Turk 1994), which every point cloud viewer opens."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.atomic import replacing
from mapper.errors import DataError
from mapper.frames import Points32

_VERTEX = np.dtype([("position", "<f4", 3), ("color", "u1", 3)])


def write_ply(path: Path, points: Points32, colors: NDArray[np.uint8]) -> None:
    """Write a little-endian binary PLY, atomically.

    Args:
        path: File to write.
        points: (N, 3) float32 metres.
        colors: (N, 3) uint8 RGB.

    Raises:
        DataError: Shapes that differ.
    """
    if points.ndim != 2 or points.shape[1] != 3 or colors.shape != points.shape:
        raise DataError(f"{path}: points {points.shape} and colors {colors.shape}, want two of (N, 3)")
    vertices = np.empty(len(points), _VERTEX)
    vertices["position"] = points
    vertices["color"] = colors
    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            "comment units: metres",
            f"element vertex {len(points)}",
            *(f"property float {axis}" for axis in ("x", "y", "z")),
            *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
            "end_header\n",
        ]
    )
    with replacing(path) as part, part.open("wb") as file:
        file.write(header.encode("ascii"))
        vertices.tofile(file)
