"""Views that a mesh is fused from: frames of a run without lens distortion, and without depth of no map.

Depth counts as in the octree: up to the same limit, and not where something moved, which the octree lacks.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError, RunError
from mapper.core.frames import (
    NO_DISTORTION,
    DepthImage,
    PinholeCamera,
    RgbdFrame,
    back_project,
    ray_table,
    undistortion_maps,
)
from mapper.core.geometry import Transform
from mapper.mapping.config import edits_of
from mapper.mapping.edits import MapEditor
from mapper.octree.map import OctreeMap
from mapper.run.folder import Run
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import Progress
from mapper.sources.base import FrameRef, Skipped

_NEAR_VOXELS = math.sqrt(3.0)
"""Noise scatters depth over voxels beside the octree's occupied ones: those that share a corner with one."""


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
    max_distance_m = _NEAR_VOXELS * octree.resolution_m
    is_mapped = octree.are_near_occupied(points_world, max_distance_m=max_distance_m)
    if editor.edits.erase or editor.edits.keep:
        is_mapped &= editor.leave(points_world)
    depth_m[measured] *= is_mapped
    return replace(frame, depth_m=depth_m)
