"""Clouds and triangle meshes: PLY (Turk 1994), Wavefront OBJ, STL, and binary glTF 2.0 (Khronos 2021)."""

import json
import struct
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import Cloud, Points32
from mapper.mapping.cloud import Colors
from mapper.runtime.atomic import atomic_file, write_bytes, write_text

_PLY_VERTEX = np.dtype([("position", "<f4", 3), ("color", "u1", 3)])
_CHUNK = 1_000_000  # vertices written at once
_STL_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
_PLY_TRIANGLE = np.dtype([("corners", "u1"), ("vertices", "<i4", 3)])


def write_ply(
    path: Path,
    points: Points32,
    colors: NDArray[np.uint8],
    *,
    triangles: NDArray[np.int32] | None = None,
    scalars: Mapping[str, NDArray[np.float32] | None] | None = None,
) -> None:
    """Write a little-endian binary PLY, atomically.

    Args:
        path: File to write.
        points: (N, 3) float32 metres.
        colors: (N, 3) uint8 RGB.
        triangles: (T, 3) int32 indices of points, counterclockwise seen from outside; None for a cloud.
        scalars: (N,) more numbers of the points by their names in the file; None leaves one out.

    Raises:
        DataError: Shapes that differ.
    """
    if points.ndim != 2 or points.shape[1] != 3 or colors.shape != points.shape:
        raise DataError(f"{path}: points {points.shape} and colors {colors.shape}, want two of (N, 3)")
    known = {name: values for name, values in (scalars or {}).items() if values is not None}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment units: metres",
        f"element vertex {len(points)}",
        *(f"property float {axis}" for axis in ("x", "y", "z")),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        *(f"property float {name}" for name in known),
    ]
    vertex = np.dtype([*_PLY_VERTEX.descr, *((name, "<f4") for name in known)])
    if triangles is not None:
        header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
    with atomic_file(path) as part, part.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode("ascii"))
        for first in range(0, len(points), _CHUNK):
            some = slice(first, first + _CHUNK)
            vertices = np.empty(len(points[some]), vertex)
            vertices["position"] = points[some]
            vertices["color"] = colors[some]
            for name, values in known.items():
                vertices[name] = values[some]
            vertices.tofile(file)
        if triangles is not None:
            faces = np.full(len(triangles), 3, _PLY_TRIANGLE)
            faces["vertices"] = triangles
            faces.tofile(file)


Triangles = NDArray[np.int32]
Write = Callable[[Path, Points32, Colors, Triangles], None]

_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125  # OpenGL's names of the types
_VERTICES, _INDICES = 34962, 34963  # and of what a buffer is for

# glTF's y is up; ours is z.
_R_GLTF_WORLD = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float32)


def write_cloud(path: Path, cloud: Cloud) -> None:
    """Write a cloud as PLY with all that it has, atomically."""
    scalars = {"intensity": cloud.intensities, "time": cloud.times_s}
    write_ply(path, cloud.points, cloud.colors, scalars=scalars)


def write_mesh(path: Path, points: Points32, colors: Colors, triangles: Triangles) -> None:
    """Write a mesh in the format that the path's ending names, atomically.

    Args:
        path: File that ends like a key of ``MESH_WRITERS``.
        points: (V, 3) float32 metres, z up.
        colors: (V, 3) uint8 RGB.
        triangles: (T, 3) int32 indices of points, counterclockwise seen from outside.
    """
    MESH_WRITERS[path.suffix.lower()](path, points, colors, triangles)


def _write_ply(path: Path, points: Points32, colors: Colors, triangles: Triangles) -> None:
    write_ply(path, points, colors, triangles=triangles)


def _write_obj(path: Path, points: Points32, colors: Colors, triangles: Triangles) -> None:
    """Write the colours behind the coordinates, as MeshLab, Blender and Open3D read them."""
    rows = np.column_stack([points, colors / 255.0]).tolist()
    lines = ["# units: metres, z up"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g} {r:.4f} {g:.4f} {b:.4f}" for x, y, z, r, g, b in rows]
    lines += [f"f {a} {b} {c}" for a, b, c in (triangles + 1).tolist()]
    write_text(path, "\n".join(lines) + "\n")


def _write_glb(path: Path, points: Points32, colors: Colors, triangles: Triangles) -> None:
    """Write one self-contained file, to be drawn as photographed: without a lamp of the viewer's own."""
    positions = np.ascontiguousarray(points @ _R_GLTF_WORLD.T, "<f4")
    rgba = np.full((len(points), 4), 0xFFFF, "<u2")  # rows of four, as glTF requires them aligned
    rgba[:, :3] = _linear_light()[colors]
    parts = [positions.tobytes(), rgba.tobytes(), triangles.astype("<u4").tobytes()]
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    content = {
        "asset": {"version": "2.0", "generator": "mapper"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}
        ],
        "materials": [{"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}],
        "accessors": [
            {"bufferView": 0, "componentType": _FLOAT, "count": len(points), "type": "VEC3", **bounds},
            {
                "bufferView": 1,
                "componentType": _UINT16,
                "normalized": True,
                "count": len(points),
                "type": "VEC4",
            },
            {"bufferView": 2, "componentType": _UINT32, "count": triangles.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(part), "target": target}
            for start, part, target in zip(starts, parts, (_VERTICES, _VERTICES, _INDICES), strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }
    text = json.dumps(content, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", starts[-1], b"BIN\0") + b"".join(parts)
    write_bytes(path, struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _linear_light() -> NDArray[np.uint16]:
    """Return (256,) uint16: the light behind every byte of an image (IEC 61966-2-1), which glTF stores."""
    level = np.arange(256) / 255.0
    light = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    rounded: NDArray[np.uint16] = np.rint(light * 0xFFFF).astype(np.uint16)
    return rounded


def _write_stl(path: Path, points: Points32, _colors: Colors, triangles: Triangles) -> None:
    """Write binary STL, which has no colours; each triangle has its normal."""
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    facets = np.zeros(len(triangles), _STL_FACET)
    facets["normal"], facets["corners"] = normals, corners
    header = b"mapper: metres, z up".ljust(80) + struct.pack("<I", len(facets))
    write_bytes(path, header + facets.tobytes())


MESH_WRITERS: dict[str, Write] = {
    ".ply": _write_ply,
    ".obj": _write_obj,
    ".glb": _write_glb,
    ".stl": _write_stl,
}
