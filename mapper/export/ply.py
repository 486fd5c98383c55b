"""Coloured clouds and meshes as binary PLY (Turk 1994), which every 3D viewer opens."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import Points32
from mapper.runtime.atomic import atomic_file

_VERTEX = np.dtype([("position", "<f4", 3), ("color", "u1", 3)])
_CHUNK = 1 << 20  # vertices written at once
_TRIANGLE = np.dtype([("corners", "u1"), ("vertices", "<i4", 3)])


def write_ply(
    path: Path,
    points: Points32,
    colors: NDArray[np.uint8],
    *,
    triangles: NDArray[np.int32] | None = None,
) -> None:
    """Write a little-endian binary PLY, atomically.

    Args:
        path: File to write.
        points: (N, 3) float32 metres.
        colors: (N, 3) uint8 RGB.
        triangles: (T, 3) int32 indices of points, counterclockwise seen from outside; None for a cloud.

    Raises:
        DataError: Shapes that differ.
    """
    if points.ndim != 2 or points.shape[1] != 3 or colors.shape != points.shape:
        raise DataError(f"{path}: points {points.shape} and colors {colors.shape}, want two of (N, 3)")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment units: metres",
        f"element vertex {len(points)}",
        *(f"property float {axis}" for axis in ("x", "y", "z")),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
    ]
    if triangles is not None:
        header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
    with atomic_file(path) as part, part.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode("ascii"))
        for first in range(0, len(points), _CHUNK):
            some = slice(first, first + _CHUNK)
            vertices = np.empty(len(points[some]), _VERTEX)
            vertices["position"] = points[some]
            vertices["color"] = colors[some]
            vertices.tofile(file)
        if triangles is not None:
            faces = np.full(len(triangles), 3, _TRIANGLE)
            faces["vertices"] = triangles
            faces.tofile(file)
