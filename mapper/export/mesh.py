"""A coloured surface from depth images at their final poses, fused by Open3D (Zhou, Park & Koltun 2018).

Depth counts as in the octree: up to the same limit, and not where something moved, which the octree lacks.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.config.build import MeshConfig
from mapper.core.back_projection import back_project
from mapper.core.errors import DependencyError, FrameError, RunError
from mapper.core.frames import (
    NO_DISTORTION,
    DepthImage,
    PinholeCamera,
    Points32,
    RgbdFrame,
    ray_table,
    undistortion_maps,
)
from mapper.core.geometry import Transform, inverse
from mapper.core.voxel_grid import DIAGONAL
from mapper.export.mesh_files import Triangles, write_mesh
from mapper.export.part_of_run import in_map, placed
from mapper.mapping.cloud import Colors
from mapper.mapping.config import edits_of
from mapper.mapping.edits import MapEditor
from mapper.octree.map import OctreeMap
from mapper.octree.sparse_grid import check_memory
from mapper.run.folder import Run
from mapper.runtime.extras import extra
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import Progress
from mapper.sources.base import FrameRef, Skipped


@dataclass(frozen=True, slots=True, eq=False)
class MeshView:
    """One frame as Open3D takes it, without lens distortion.

    Attributes:
        depth_m: (H, W) float32 metres along the optical axis, 0 where nothing counts.
        colors: (H, W, 3) float32 RGB, 0 … 1.
        camera: Camera of both, whose distortion has been removed.
        T_world_camera: (4, 4) pose of the camera.
    """

    depth_m: DepthImage
    colors: NDArray[np.float32]
    camera: PinholeCamera
    T_world_camera: Transform


def mesh_views(run: Run, octree: OctreeMap, progress: Progress) -> Iterator[MeshView]:
    """Yield every ``mesh.frame_stride``-th tracked frame, read and rectified ahead in threads.

    Args:
        run: The run, whose log is read again.
        octree: Its map.
        progress: Receives the stage and notes on frames that cannot be read.

    Raises:
        RunError: The log has moved or changed, or holds no depth images.
    """
    trajectory = run.tracked_trajectory
    stride = run.config.mesh.frame_stride
    editor = MapEditor(edits_of(run.manifest.edits), trajectory.positions_world, room_m=0.0)
    T_world_body = dict(trajectory[::stride].items())
    source = run.open_log()

    def prepare(entry: FrameRef) -> MeshView | Skipped:
        try:
            frame = entry.load()
        except FrameError as error:
            return Skipped(entry.stamp_ns, str(error))
        if not isinstance(frame, RgbdFrame):
            raise RunError(f"{source.path}: a mesh needs depth images, and this log has none")
        T = T_world_body[entry.stamp_ns]
        return rectified(as_mapped(frame, T, octree, editor), T)

    views = ordered_map(prepare, source.entries_of(T_world_body), workers=run.config.workers)
    with progress.stage("mesh") as report:
        for done, view in enumerate(views, start=1):
            report(done, len(T_world_body))
            if isinstance(view, Skipped):
                progress.note(f"not fused: {view.reason}")
            else:
                yield view


def rectified(frame: RgbdFrame, T_world_body: Transform) -> MeshView:
    """Resample a frame as an ideal pinhole camera would have seen it; depths are not mixed."""
    depth_m, image = frame.depth_m, frame.rgb
    if frame.camera.distortion != NO_DISTORTION:
        columns, rows = undistortion_maps(frame.camera)
        depth_m = cv2.remap(depth_m, columns, rows, cv2.INTER_NEAREST)
        image = cv2.remap(image, columns, rows, cv2.INTER_LINEAR)
    return MeshView(
        np.ascontiguousarray(depth_m, np.float32),
        np.asarray(image, np.float32) / np.float32(255.0),
        frame.camera,
        T_world_body @ frame.T_body_camera,
    )


def as_mapped(frame: RgbdFrame, T_world_body: Transform, octree: OctreeMap, editor: MapEditor) -> RgbdFrame:
    """Return a frame without depth that is edited away, or far from all that is occupied in the octree."""
    measured = (frame.depth_m > 0.0) & np.isfinite(frame.depth_m)
    depth_m = np.where(measured, frame.depth_m, np.float32(0.0))
    points_world = back_project(depth_m, ray_table(frame.camera), T_world_body @ frame.T_body_camera)
    # Noise scatters depth over voxels beside the octree's occupied ones: those that share a corner with one.
    max_distance_m = DIAGONAL * octree.resolution_m
    is_mapped = octree.are_near_occupied(points_world, max_distance_m=max_distance_m)
    if editor.edits.erase or editor.edits.keep:
        is_mapped &= editor.leave(points_world)
    depth_m[measured] *= is_mapped
    return replace(frame, depth_m=depth_m)


_BLOCK_VOXELS = 8
"""Edge of a block. Of Open3D's usual 16 two thirds would lie beyond the truncation, and be computed."""
_TRUNCATION_VOXELS = 4.0
"""How far from the surface distances count; thinner than the depth noise tears holes."""
_VOXEL_BYTES = 5 * np.dtype(np.float32).itemsize
"""Distance, weight and colour, all float32: integers would round at every frame."""
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
    for view in mesh_views(in_map(run), octree, progress):
        volume.add(view)
    found = volume.surface()
    if not len(found.triangles):
        raise RunError(
            f"{run.path}: no surface within {max_depth_m:g} m was seen in {config.min_observations} "
            "fused frames; lower mesh.min_observations or mesh.frame_stride"
        )
    write_mesh(path, placed(run, found.points_world), found.colors, found.triangles)


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
