"""Fusing of the clouds: that of what stands still, and that of what moved.

Scans get their colours by the images of the cameras beside the LiDAR.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError, listed
from mapper.core.frames import Cloud, Points32
from mapper.core.geometry import Array, Transform, apply, inverse
from mapper.core.timebase import NS_PER_S, nearest
from mapper.core.trajectory import Trajectory
from mapper.mapping.cloud import CloudBuilder, height_colors
from mapper.mapping.config import FuseSettings
from mapper.mapping.placed_frames import (
    MOST_APART_NS,
    PlacedFrame,
    frames_in_order,
    sensor_paths,
    within_reach,
)
from mapper.octree.moving_objects import MovingObjects
from mapper.octree.ray_casting import depth_limit_of
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import Progress
from mapper.sources.base import CameraImages, Log

_COLOURED_HEIGHTS_M = -1.0, 8.0  # the same in every scan
_IN_FRONT = 0.8
"""What lies nearer than this share of a depth covers it. Of ground and walls at grazing angles, points of
one cell differ by less up to 40 m before a car, or 10 m before a small robot."""
_LEFT = np.zeros((5, 5), np.uint8)
_LEFT[2, :2] = 1
_SIDES = _LEFT, _LEFT[:, ::-1].copy(), _LEFT.T.copy(), _LEFT.T[::-1].copy()
"""Cells on each side of a point's own whose nearest points may cover it."""


def build_clouds(
    source: Log,
    trajectory: Trajectory,
    config: FuseSettings,
    objects: MovingObjects | None,
    *,
    progress: Progress,
) -> tuple[Cloud, Cloud]:
    """Return the clouds of what stands still and of what moved.

    Every ``cloud.frame_stride``-th frame adds its points; frames that cannot be read are left out.

    Args:
        source: The log that was tracked.
        trajectory: Final body poses in the levelled world.
        config: Settings of the maps.
        objects: What moved; None if it is not separated.
        progress: Receives progress.
    """
    still, moving = CloudBuilder(config.cloud.voxel_m), CloudBuilder(config.cloud.voxel_m)
    stride = config.cloud.frame_stride
    paths = sensor_paths(source, trajectory)
    frames = [frame for frame in frames_in_order(paths) if frame.index % stride == 0]
    depth_limit, begin_ns = depth_limit_of(config.octree), int(trajectory.stamps_ns[0])

    colouring = ScanColouring(source.images, trajectory) if source.images else None

    def read(frame: PlacedFrame) -> tuple[float, Cloud, NDArray[np.bool_], NDArray[np.bool_] | None] | None:
        """Return a frame's time, returns, which moved and which have a colour (None: all); None if unread."""
        try:
            scan = frame.scan_of(frame.entry.load())
        except FrameError:
            return None
        scan, _ = within_reach(scan, frame.T_world_body, config.octree)
        if depth_limit is not None and frame.sensor == "rgbd":
            scan, _ = depth_limit.split(scan)
        R, t = (part.astype(np.float32) for part in (frame.T_world_body[:3, :3], frame.T_world_body[:3, 3]))
        points_world, colors, has_color = scan.points_body @ R.T + t, scan.colors, None
        if colors is None and colouring is not None:
            colors, has_color = colouring.colour(points_world, scan.stamp_ns)
        elif colors is None and source.has_colours:  # those of a LiDAR beside a camera
            colors = np.zeros(scan.points_body.shape, np.uint8)
            has_color = np.zeros(len(colors), np.bool_)
        elif colors is None:  # no sensor has colours: heights are shown by them
            colors = height_colors(points_world[:, 2], between_m=_COLOURED_HEIGHTS_M)
        cloud = Cloud(points_world, colors, scan.intensities)
        moved = np.zeros(len(cloud), np.bool_) if objects is None else objects.returns_of(points_world)
        return (frame.entry.stamp_ns - begin_ns) / NS_PER_S, cloud, moved, has_color

    with progress.stage("cloud") as report:
        for done, returns in enumerate(ordered_map(read, frames, workers=config.workers), start=1):
            report(done, len(frames))
            if returns is not None:
                time_s, cloud, moved, has_color = returns
                for builder, kept in ((still, ~moved), (moving, moved)):
                    coloured = None if has_color is None else has_color[kept]
                    builder.add(cloud.select(kept), time_s, has_color=coloured)
    if colouring is not None:
        names = listed([images.name for images in source.images])
        progress.note(
            f"cloud: {still.coloured_share:.0%} of the points have a colour by {names}, others are grey"
        )
    return still.cloud(), moving.cloud()


class ScanColouring:
    """Colouring of points by the images that were taken next to their time, at the poses of the path."""

    def __init__(self, images: Sequence[CameraImages], trajectory: Trajectory) -> None:
        """Begin with all cameras.

        Args:
            images: Those of each camera.
            trajectory: T_world_body of the frames that were placed.
        """
        self._images = images
        self._trajectory = trajectory

    def colour(self, points_world: Points32, stamp_ns: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return the (N, 3) uint8 RGB of a scan's points, and (N,) which a camera sees; safe in any thread.

        Args:
            points_world: (N, 3) float32 metres.
            stamp_ns: Time of the scan.
        """
        colors = np.zeros(points_world.shape, np.uint8)
        is_seen = np.zeros(len(points_world), np.bool_)
        for images in self._images:
            (index,), (apart_ns,) = nearest(images.stamps_ns, np.array([stamp_ns]))
            T_world_body = self._pose(int(images.stamps_ns[index]))
            if T_world_body is None or apart_ns > MOST_APART_NS:
                continue
            T_camera_world = inverse(T_world_body @ images.T_body_camera)
            points, pixels = _visible(apply(T_camera_world, points_world.astype(np.float64)), images)
            new = ~is_seen[points]
            points, pixels = points[new], pixels[new]
            if len(points) == 0:
                continue
            try:
                image = images.image_at(int(index))
            except FrameError:
                continue
            seen = image[pixels[:, 1], pixels[:, 0]]
            colors[points] = seen if image.ndim == 3 else seen[:, None]
            is_seen[points] = True
        return colors, is_seen

    def _pose(self, stamp_ns: int) -> Transform | None:
        """Return T_world_body at an image's time; None where it is too far from any pose."""
        stamps_ns = self._trajectory.stamps_ns
        _, (apart_ns,) = nearest(stamps_ns, np.array([stamp_ns]))
        if apart_ns > MOST_APART_NS:
            return None
        return self._trajectory.at(int(np.clip(stamp_ns, stamps_ns[0], stamps_ns[-1])))


def _visible(points_camera: Array, images: CameraImages) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return which points of a scan a camera sees, and the (M, 2) pixels (column, row) that show them."""
    camera = images.camera
    size_px = np.array([camera.width_px, camera.height_px])
    ahead = np.flatnonzero(points_camera[:, 2] > 0.0)
    ideal = camera.project(points_camera[ahead])
    # A distortion folds what is far outside of the view back into it.
    near = (np.abs(ideal - 0.5 * (size_px - 1.0)) < size_px).all(axis=1)
    ahead, ideal = ahead[near], ideal[near]
    pixels = np.rint(camera.distort(ideal)).astype(np.intp)
    inside = ((pixels >= 0) & (pixels < size_px)).all(axis=1)
    ahead, pixels = ahead[inside], pixels[inside]
    if len(ahead) == 0:
        return ahead, pixels
    uncovered = _are_uncovered(pixels, points_camera[ahead, 2], size_px)
    return ahead[uncovered], pixels[uncovered]


def _are_uncovered(pixels: NDArray[np.intp], depth_m: Array, size_px: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which points have no nearer ones on both sides, along a row or a column of the image.

    Of ground that is seen at a grazing angle nearer points lie on one side alone.
    """
    edge_px = max(1.0, math.sqrt(float(size_px.prod()) / len(pixels)))
    columns, rows = (pixels / edge_px).astype(np.intp).T
    width, height = np.ceil(size_px / edge_px).astype(np.intp)
    nearest_m = np.full((height, width), np.inf, np.float32)
    np.minimum.at(nearest_m, (rows, columns), depth_m.astype(np.float32))
    left, right, above, below = (cv2.erode(nearest_m, side)[rows, columns] for side in _SIDES)
    between_m = np.minimum(np.maximum(left, right), np.maximum(above, below))
    uncovered: NDArray[np.bool_] = between_m >= _IN_FRONT * depth_m
    return uncovered
