"""A coloured surface from depth images at their final poses, fused by Open3D (Zhou, Park & Koltun 2018)."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mapper.config.build import MeshConfig
from mapper.core.errors import DependencyError, RunError
from mapper.core.frames import Points32
from mapper.core.geometry import inverse
from mapper.export.mesh_files import Triangles, write_mesh
from mapper.export.mesh_views import MeshView, mesh_views
from mapper.mapping.cloud import Colors
from mapper.octree.blocks import check_memory
from mapper.octree.map import OctreeMap
from mapper.run.folder import Run
from mapper.runtime.extras import extra
from mapper.runtime.progress import Progress

_BLOCK_VOXELS = 8
"""Edge of a block. Of Open3D's usual 16 two thirds would lie beyond the truncation, and be computed."""
_TRUNCATION_VOXELS = 4.0
"""How far from the surface distances count; thinner than the depth noise tears holes."""
_VOXEL_BYTES = 4 + 4 + 12  # distance, weight and colour, all float32: integers would round at every frame
_LIBRARIES = "libgl1 libegl1 libx11-6 libudev1 libusb-1.0-0 libidn2-0 libgomp1"


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Triangles in an order that depends on the surface alone.

    Attributes:
        points_world: (V, 3) float32 metres.
        colors: (V, 3) uint8 RGB.
        triangles: (T, 3) int32 indices of points, counterclockwise seen from outside.
    """

    points_world: Points32
    colors: Colors
    triangles: Triangles


def surface(run: Run, path: Path, progress: Progress) -> None:
    """Fuse every ``mesh.frame_stride``-th tracked frame of the log and write the surface.

    Depth far from all that is occupied in the run's octree is left out: it is of what moved. So is what was
    edited away by hand.
    Memory grows with the surface seen, not with the log.

    Raises:
        DependencyError: Open3D or a system library that it needs is missing.
        RunError: The log has moved or changed, holds no depth images, or too little of it was seen.
        MapSizeError: The surface would not fit into memory at ``mesh.voxel_m``.
    """
    o3d = _open3d()
    config = run.config.mesh
    octree, max_depth_m = run.octree, _max_depth_m(run)
    volume = Volume(o3d, config, max_depth_m=max_depth_m, blocks=_expected_blocks(octree, config))
    for view in mesh_views(run, octree, progress):
        volume.add(view)
    found = volume.surface()
    if not len(found.triangles):
        raise RunError(
            f"{run.path}: no surface within {max_depth_m:g} m was seen in {config.min_observations} "
            "fused frames; lower mesh.min_observations or mesh.frame_stride"
        )
    write_mesh(path, found.points_world, found.colors, found.triangles)


class Volume:
    """Truncated signed distances in Open3D's hash of voxel blocks (Curless & Levoy 1996)."""

    def __init__(self, o3d: Any, config: MeshConfig, *, max_depth_m: float, blocks: int) -> None:
        """Start empty.

        Args:
            o3d: The module of Open3D.
            config: Settings of the mesh.
            max_depth_m: Deeper measurements are left out.
            blocks: Number of blocks that room is made for.
        """
        self._o3d = o3d
        self._config = config
        self._max_depth_m = max_depth_m
        number = o3d.core.float32
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(number, number, number),
            attr_channels=(1, 1, 3),
            voxel_size=config.voxel_m,
            block_resolution=_BLOCK_VOXELS,
            block_count=blocks,  # growing means copying everything, and triples the time
        )

    def add(self, view: MeshView) -> None:
        """Fuse one view."""
        tensor, image = self._o3d.core.Tensor, self._o3d.t.geometry.Image
        depth, color = image(tensor(view.depth_m)), image(tensor(view.colors))
        intrinsic, extrinsic = tensor(view.camera.matrix), tensor(inverse(view.T_world_camera))
        # Depth is in metres already, so Open3D's scale is 1.
        reach = (1.0, self._max_depth_m, _TRUNCATION_VOXELS)
        blocks = self._grid.compute_unique_block_coordinates(depth, intrinsic, extrinsic, *reach)
        self._grid.integrate(blocks, depth, color, intrinsic, extrinsic, *reach)

    def surface(self) -> Surface:
        """Extract where the distance changes sign (marching cubes, Lorensen & Cline 1987)."""
        mesh = self._grid.extract_triangle_mesh(weight_threshold=float(self._config.min_observations))
        if not len(mesh.triangle.indices):
            return Surface(
                np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8), np.empty((0, 3), np.int32)
            )
        colors = np.rint(np.clip(mesh.vertex.colors.numpy(), 0.0, 1.0) * 255.0).astype(np.uint8)
        return in_order(mesh.vertex.positions.numpy(), colors, mesh.triangle.indices.numpy())


def in_order(points: Points32, colors: Colors, triangles: Triangles) -> Surface:
    """Return a surface with sorted vertices and triangles: Open3D gives them in the order of its threads.

    Args:
        points: (V, 3) float32 metres.
        colors: (V, 3) uint8 RGB.
        triangles: (T, 3) int32 indices of points.
    """
    order = np.lexsort((*colors.T, *points.T))
    points, colors = points[order], colors[order]
    is_new = np.ones(len(order), np.bool_)  # equal vertices have no order, so they become one
    is_new[1:] = (np.diff(points, axis=0) != 0).any(axis=1) | (colors[1:] != colors[:-1]).any(axis=1)
    rank = np.empty(len(order), np.int32)
    rank[order] = np.cumsum(is_new, dtype=np.int32) - 1
    triangles = rank[triangles]
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    first = triangles.argmin(axis=1)[:, np.newaxis]
    triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)  # turned, not mirrored
    return Surface(points[is_new], colors[is_new], triangles[np.lexsort(triangles.T[::-1])])


def _max_depth_m(run: Run) -> float:
    """Return the depth up to which measurements count."""
    if run.config.mesh.max_depth_m is not None:
        return run.config.mesh.max_depth_m
    depth = run.manifest.depth
    return run.config.octree.range_limit_m if depth is None else depth.limit_m


def _expected_blocks(octree: OctreeMap, config: MeshConfig) -> int:
    """Estimate from the octree how many blocks the surface will fill, and refuse what could not fit."""
    block_m = _BLOCK_VOXELS * config.voxel_m
    shell_blocks = 1.0 + 2.0 * _TRUNCATION_VOXELS / _BLOCK_VOXELS
    blocks = int(octree.count_occupied() * (octree.resolution_m / block_m) ** 2 * shell_blocks) + 1
    check_memory(
        blocks * _BLOCK_VOXELS**3 * _VOXEL_BYTES,
        f"a mesh of {config.voxel_m:g} m voxels",
        remedy="raise mesh.voxel_m",
    )
    return blocks


def _open3d() -> Any:
    try:
        with extra("mesh", "a mesh"):
            import open3d
    except (ImportError, OSError) as error:
        found = re.search(r"lib[\w.+-]+\.so[.\d]*", str(error))
        raise DependencyError(
            f"mesh: Open3D cannot be loaded, {found[0] if found else error} is missing; "
            f"apt-get install {_LIBRARIES}"
        ) from None
    return open3d
