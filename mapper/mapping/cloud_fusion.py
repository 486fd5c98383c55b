"""Fusing of the clouds: that of what stands still, and that of what moved."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError, listed
from mapper.core.frames import Cloud
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.mapping.cloud import CloudBuilder, height_colors
from mapper.mapping.colouring import ScanColouring
from mapper.mapping.config import FuseSettings
from mapper.mapping.placed_frames import PlacedFrame, fused_frames, sensor_paths, within_reach
from mapper.octree.moving_objects import MovingObjects
from mapper.octree.ray_casting import depth_limit_of
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import Progress
from mapper.sources.base import Log

_COLOURED_HEIGHTS_M = -1.0, 8.0  # the same in every scan


def fuse_clouds(
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
    frames = [frame for frame in fused_frames(paths) if frame.index % stride == 0]
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
