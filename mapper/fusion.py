"""The second pass over a log: every tracked frame fused at its final pose."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from mapper.cloud import CloudBuilder, Colors
from mapper.config import BuildConfig, McapConfig
from mapper.errors import FrameError
from mapper.export.jpeg import encode_jpeg, shrunk_camera
from mapper.frames import Frame, PinholeCamera, Points32, RgbdFrame, Scan
from mapper.geometry import Transform
from mapper.navigation.traversable import traversable
from mapper.octree.map import OctreeMap
from mapper.octree.slice import OccupancyGrid, cut_slice
from mapper.parallel import ordered_map
from mapper.progress import Progress
from mapper.sources.base import Entry, FrameSource
from mapper.trajectory import Trajectory

_NO_COLOUR = 128  # mid grey: for the points of a sensor that sees no colour


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A small JPEG of one frame.

    Attributes:
        stamp_ns: The frame's stamp.
        jpeg: The image.
        camera: Its camera, as small as the image.
        T_body_camera: (4, 4) pose of the camera in the body.
    """

    stamp_ns: int
    jpeg: bytes
    camera: PinholeCamera
    T_body_camera: Transform


@dataclass(frozen=True, slots=True, eq=False)
class Maps:
    """What fusing yields.

    Attributes:
        octree: Occupied, free and unknown space.
        cloud_points_world: (N, 3) float32 metres, levelled world.
        cloud_colors: (N, 3) uint8 RGB.
        grid: The slice through the octree above the floor.
        traversable: The floor that a robot can drive on.
    """

    octree: OctreeMap
    cloud_points_world: Points32
    cloud_colors: Colors
    grid: OccupancyGrid
    traversable: OccupancyGrid


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """A frame to fuse: where it was, and who wants to see it in colour."""

    entry: Entry
    T_world_body: Transform
    feeds_cloud: bool
    feeds_log: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Fused:
    """A frame decoded and back-projected, or the reason why not."""

    job: _Job
    scan: Scan | None = None
    snapshot: Snapshot | None = None
    reason: str = ""


def fuse_log(
    source: FrameSource,
    trajectory: Trajectory,
    config: BuildConfig,
    *,
    progress: Progress,
    on_snapshot: Callable[[Snapshot], None],
) -> Maps:
    """Fuse every frame of the trajectory, in time order; decoding and back-projection run ahead in threads.

    Args:
        source: The log that was tracked.
        trajectory: Final body poses in the levelled world; frames without a pose are left out.
        config: The octree, cloud, slice and mcap parts matter.
        progress: Who watches.
        on_snapshot: Gets every ``mcap.image_stride``-th frame's image.
    """
    octree, cloud = OctreeMap(config.octree), CloudBuilder(config.cloud.voxel_m)

    def prepare(job: _Job) -> _Fused:
        return _prepared(job, config.mcap)

    prepared = ordered_map(prepare, _jobs(source, trajectory, config), workers=config.workers)
    with progress.stage("fuse") as report:
        for done, fused in enumerate(prepared, start=1):
            report(done, len(trajectory))
            if fused.scan is None:
                progress.note(f"not fused: {fused.reason}")
                continue
            octree.insert(fused.scan, fused.job.T_world_body)
            if fused.job.feeds_cloud:
                _add_to_cloud(cloud, fused.scan, fused.job.T_world_body)
            if fused.snapshot is not None:
                on_snapshot(fused.snapshot)
    grid, floor = cut_slice(octree, config.slice), traversable(octree, config.traversable)
    return Maps(octree, *cloud.points_and_colors(), grid, floor)


def _jobs(source: FrameSource, trajectory: Trajectory, config: BuildConfig) -> Iterator[_Job]:
    index_of = {int(stamp_ns): index for index, stamp_ns in enumerate(trajectory.stamps_ns)}
    image_stride = config.mcap.image_stride
    for entry in source.entries():
        index = index_of.get(entry.stamp_ns)
        if index is not None:
            yield _Job(
                entry,
                trajectory.T_world_body[index],
                feeds_cloud=index % config.cloud.frame_stride == 0,
                feeds_log=image_stride > 0 and index % image_stride == 0,
            )


def _prepared(job: _Job, config: McapConfig) -> _Fused:
    """Read one frame; its image costs most of the decoding, so only those who want it pay."""
    try:
        if not (job.feeds_cloud or job.feeds_log):
            return _Fused(job, job.entry.scan())
        frame = job.entry.load()
    except FrameError as error:  # it was readable in the first pass, so the log changed under us
        return _Fused(job, reason=str(error))
    return _Fused(job, frame.scan(), _snapshot(frame, config) if job.feeds_log else None)


def _snapshot(frame: Frame, config: McapConfig) -> Snapshot | None:
    if not isinstance(frame, RgbdFrame):
        return None
    return Snapshot(
        frame.stamp_ns,
        encode_jpeg(frame.image, width_px=config.image_width_px, quality=config.image_quality),
        shrunk_camera(frame.camera, width_px=config.image_width_px),
        frame.T_body_camera,
    )


def _add_to_cloud(cloud: CloudBuilder, scan: Scan, T_world_body: Transform) -> None:
    R, t = T_world_body[:3, :3].astype(np.float32), T_world_body[:3, 3].astype(np.float32)
    points_world = scan.points_body @ R.T + t
    colors = scan.colors
    if colors is None:
        colors = np.full(points_world.shape, _NO_COLOUR, np.uint8)
    cloud.add(points_world, colors)
