"""Fusing: the second pass over a log, in which every tracked frame is added to the maps at its final pose."""

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.errors import DataError, FrameError
from mapper.core.frames import Cloud, Frame, PinholeCamera, Points32, RgbdFrame, Scan, Sensor
from mapper.core.geometry import Transform
from mapper.core.trajectory import Trajectory
from mapper.core.voxel_grid import thin
from mapper.mapping.cloud_building import build_clouds
from mapper.mapping.config import AppliedEdit, Edits, FuseSettings, McapConfig
from mapper.mapping.edits import MapEditor
from mapper.mapping.placed_frames import PlacedFrame, frames_in_order, sensor_paths, within_reach
from mapper.mapping.thumbnails import encode_jpeg, shrunk_camera
from mapper.navigation.reachable_floor import driven_ground, reachable_floor
from mapper.navigation.traversable_grid import traversable
from mapper.octree.config import OctreeConfig
from mapper.octree.grid import OccupancyGrid
from mapper.octree.map import OctreeMap
from mapper.octree.moving_objects import MovingObjects, remove_moving_objects
from mapper.octree.ray_casting import Caster, reach_m
from mapper.octree.scan_updates import (
    CachedUpdate,
    ScanUpdate,
    ScanUpdateFile,
    ScanUpdateWriter,
    cache_update,
    pack,
)
from mapper.octree.slice import Band, cut_slice
from mapper.registration.config import VOXEL_M
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import Progress
from mapper.sources.base import Log, Skipped

_FARTHEST_VOXELS = 500
"""Longest ray, in voxels, of a LiDAR beside a depth camera, whose voxels are small: 25 m in voxels of 5 cm.
Rays of 100 m would take 50 times the memory, and the maps of the camera end at some metres."""


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
class ScanSnapshot:
    """A thinned scan.

    Attributes:
        stamp_ns: The scan's stamp.
        points_body: (N, 3) float32 metres, body frame.
    """

    stamp_ns: int
    points_body: Points32


@dataclass(frozen=True, slots=True, eq=False)
class Maps:
    """The maps of a run.

    Attributes:
        octree: Occupied, free and unknown space.
        cloud: Points in the levelled world, all in occupied voxels of the octree.
        dynamic: Points of what moved, which is in no map.
        grid: The slice through the octree above the floor.
        traversable: The floor that a robot can drive on, of the storey on which the path begins.
        storeys: The same of every storey, the lowest first, where floors lie over each other.
        keepout: The keep-out regions in the slice's cells; None if there are none.
        has_path: Whether the height of the floor is known from the path.
        edits: The edits by hand that are in them.
    """

    octree: OctreeMap
    cloud: Cloud
    dynamic: Cloud
    grid: OccupancyGrid
    traversable: OccupancyGrid
    storeys: tuple[OccupancyGrid, ...]
    keepout: OccupancyGrid | None
    has_path: bool = True
    edits: tuple[AppliedEdit, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """A frame to fuse.

    Attributes:
        frame: The frame.
        cached: Its update from the last time, if that still holds.
        is_logged: Whether its image or scan is logged.
    """

    frame: PlacedFrame
    cached: CachedUpdate | None
    is_logged: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Prepared:
    """A frame's update, before the octree is updated with it.

    Attributes:
        job: The frame.
        update: What it shows.
        cached: The same, to be stored.
        scan: The scan; None if it was not read.
        snapshot: Its small image or thinned scan; None if it is not logged.
        unreached: Number of points that were left out, since the octree's keys do not reach them.
    """

    job: _Job
    update: ScanUpdate
    cached: CachedUpdate
    scan: Scan | None
    snapshot: Snapshot | ScanSnapshot | None
    unreached: int = 0


def build_maps(
    source: Log,
    trajectory: Trajectory,
    config: FuseSettings,
    *,
    progress: Progress,
    on_snapshot: Callable[[Snapshot | ScanSnapshot], None],
    cached: ScanUpdateFile | None,
    updates: ScanUpdateWriter,
    edits: Edits,
) -> Maps:
    """Fuse every frame of the trajectory, in time order; decoding and casting run ahead in threads.

    Frames of the sensors beside the tracked one are fused too, at the poses of the path at their times.

    Then what moved is removed, unless ``octree.moving`` keeps it, and the edits by hand are made. The cached
    update of a frame whose pose is the same is merged without reading the frame, to the same bits.

    Args:
        source: The log that was tracked.
        trajectory: Final body poses in the levelled world; frames without a pose are left out.
        config: Settings of the maps and of the MCAP log.
        progress: Receives progress and notes.
        on_snapshot: Receives every ``mcap.image_stride``-th frame's image, or its points if it has no image.
        cached: The frames' updates from the last time they were fused; None reads and casts all.
        updates: Receives the frames' updates.
        edits: Regions to erase, to keep and to block.

    Raises:
        DataError: The edits leave nothing of the map, or nothing in the height of the slice.
    """
    octree, objects = _insert_scans(
        source, trajectory, config, progress, on_snapshot=on_snapshot, cached=cached, updates=updates
    )
    cloud, dynamic = build_clouds(source, trajectory, config, objects, progress=progress)
    if objects is not None:
        progress.note(f"moving objects: {len(dynamic)} of {len(cloud) + len(dynamic)} points of the clouds")
    editor = MapEditor(edits, trajectory.positions_world, config.traversable.head_room_m)
    known, occupied = len(octree), np.count_nonzero(octree.are_occupied(cloud.points))
    erased = editor.erase(octree)
    floor = reachable_floor(octree, config.traversable, positions_world=trajectory.positions_world)
    driven = editor.crop_ground(driven_ground(floor), floor.columns)
    cropped = editor.crop(octree)
    grid = cut_slice(octree, config.slice, driven=driven)
    floor_below = Band(config.slice, octree.resolution_m).floor_below(grid, driven)
    octree.drop_unknown()  # the slice has the columns of all blocks, as the floor
    passable, blocked = editor.edit_floor(traversable(floor, config.traversable))
    kept = octree.are_occupied(cloud.points)
    made = (*erased, *cropped, *blocked)
    if made:
        progress.note(
            f"edits by hand: {sum(edit.count for edit in erased)} voxels made free; {known - len(octree)} "
            f"voxels and {occupied - np.count_nonzero(kept)} points of the cloud left out"
        )
    if idle := [edit.text for edit in made if not edit.count]:
        progress.note(f"edits by hand without effect: {'; '.join(idle)}; are they in the frame of this map?")
    return Maps(
        octree=octree,
        cloud=cloud.select(kept),
        dynamic=dynamic,
        grid=grid,
        traversable=passable.home.grid,
        storeys=passable.over_each_other,
        keepout=editor.keepout(grid, floor_below),
        has_path=len(floor.path) > 0,
        edits=made,
    )


def build_octree(
    source: Log,
    trajectory: Trajectory,
    config: FuseSettings,
    *,
    progress: Progress,
    cached: ScanUpdateFile | None,
    updates: ScanUpdateWriter,
    edits: Edits,
) -> OctreeMap:
    """Return the octree of ``build_maps`` alone; frames whose cached update still holds are not read.

    Args:
        source: As for ``build_maps``, as are all others.
        trajectory: Final body poses in the levelled world.
        config: Settings of the maps.
        progress: Receives progress and notes.
        cached: The frames' updates from the last time.
        updates: Receives the frames' updates.
        edits: Regions to erase and to keep.

    Raises:
        DataError: The edits leave nothing of the map.
    """
    octree, _ = _insert_scans(source, trajectory, config, progress, cached=cached, updates=updates)
    editor = MapEditor(edits, trajectory.positions_world, config.traversable.head_room_m)
    editor.erase(octree)
    editor.crop(octree)
    octree.drop_unknown()
    return octree


def _insert_scans(
    source: Log,
    trajectory: Trajectory,
    config: FuseSettings,
    progress: Progress,
    *,
    cached: ScanUpdateFile | None,
    updates: ScanUpdateWriter,
    on_snapshot: Callable[[Snapshot | ScanSnapshot], None] | None = None,
) -> tuple[OctreeMap, MovingObjects | None]:
    """Return the octree of all frames, and what moved, which is removed from it; None if it is kept."""
    octree = OctreeMap(config.octree, folder=updates.folder)
    if cached is not None and (config.octree.attributes or not cached.holds_for(config.octree)):
        cached = None  # updates have no colours
    log_stride = 0 if on_snapshot is None else config.mcap.image_stride
    paths = sensor_paths(source, trajectory)
    jobs = _jobs(paths, config, cached, log_stride=log_stride)
    casters, moved, unreached = _Casters(config.octree, source.sensor), 0, 0
    total = sum(len(path) for _, path in paths)
    T_world_camera: list[Transform | None] = []
    prepared = ordered_map(lambda job: _prepared(job, config, casters), jobs, workers=config.workers)
    with progress.stage("fuse") as report:
        for done, one in enumerate(prepared, start=1):
            report(done, total)
            if isinstance(one, Skipped):
                progress.note(f"not fused: {one.reason}")
                continue
            if one.scan is not None and config.octree.attributes:
                octree.insert(one.scan, one.job.frame.T_world_body, casters.of(one.job.frame.sensor))
            else:
                octree.merge(one.update)
            updates.add(one.cached)
            T_world_camera.append(one.cached.T_world_body if one.job.frame.sensor == "rgbd" else None)
            moved += one.job.cached is None
            unreached += one.unreached
            if one.snapshot is not None and on_snapshot is not None:
                on_snapshot(one.snapshot)
    if unreached:
        progress.note(
            f"{unreached} points lie farther than {reach_m(config.octree.resolution_m):g} m from the map's "
            f"origin, beyond the reach of {config.octree.resolution_m:g} m voxels; left out"
        )
    if cached is not None:
        progress.note(f"fused again: {moved} of {total} frames, which had moved or were not known")
    if config.octree.moving != "removed":
        return octree, None
    with updates.reopen() as written:
        return octree, remove_moving_objects(
            octree, written.replay(workers=config.workers), T_world_camera=T_world_camera
        )


def _rays_of(config: OctreeConfig, sensor: Sensor, tracked: Sensor) -> OctreeConfig:
    """Return the settings of a sensor's rays: only a depth camera's are limited by the noise of depth."""
    if sensor == "rgbd" or (sensor == tracked and config.depth_noise is None):
        return config
    range_m = config.max_range_m
    if range_m is None and tracked == "rgbd":
        range_m = _FARTHEST_VOXELS * config.resolution_m
    return config.model_copy(update={"depth_noise": None, "max_range_m": range_m})


class _Casters(threading.local):
    """A caster for every thread and sensor."""

    def __init__(self, config: OctreeConfig, tracked: Sensor) -> None:
        self._config, self._tracked = config, tracked
        self._by_sensor: dict[Sensor, Caster] = {}

    def of(self, sensor: Sensor) -> Caster:
        """Return the caster of a kind of sensor."""
        if sensor not in self._by_sensor:
            self._by_sensor[sensor] = Caster(_rays_of(self._config, sensor, self._tracked))
        return self._by_sensor[sensor]


def _jobs(
    paths: Sequence[tuple[Log, Trajectory]],
    config: FuseSettings,
    cached: ScanUpdateFile | None,
    *,
    log_stride: int,
) -> Iterator[_Job]:
    tracked = paths[0][0].sensor
    for frame in frames_in_order(paths):
        update, rays = None, _rays_of(config.octree, frame.sensor, tracked)
        if cached is not None and (frame.sensor == "rgbd" or _neighbours_hold(cached, frame, rays)):
            update = cached.lookup(frame.entry.stamp_ns, frame.T_world_body, config=rays)
        yield _Job(frame, update, is_logged=log_stride > 0 and frame.index % log_stride == 0)


def _neighbours_hold(cached: ScanUpdateFile, frame: PlacedFrame, config: OctreeConfig) -> bool:
    """Return whether the poses before and after one still hold: a scan is deskewed between them."""
    trajectory, index = frame.trajectory, frame.index
    return all(
        cached.holds(int(trajectory.stamps_ns[neighbour]), trajectory.T_world_body[neighbour], config=config)
        for neighbour in (index - 1, index + 1)
        if 0 <= neighbour < len(trajectory)
    )


def _prepared(job: _Job, config: FuseSettings, casters: _Casters) -> _Prepared | Skipped:
    """Read and cast one frame as far as needed: images cost most, and cached updates nothing."""
    frame, scan, snapshot = job.frame, None, None
    caster = casters.of(frame.sensor)
    try:
        loaded = frame.entry.load() if job.is_logged or config.octree.attributes else None
        if loaded is not None:
            scan = frame.scan_of(loaded)
            snapshot = _snapshot(loaded, scan, config.mcap) if job.is_logged else None
        is_moved = isinstance(loaded, RgbdFrame) and loaded.is_depth_moved
        if job.cached is None and not config.octree.attributes and (loaded is None or is_moved):
            scan = frame.scan_of(frame.entry.scan())
    except FrameError as error:  # readable in the first pass: the log has changed since
        return Skipped(frame.entry.stamp_ns, str(error))
    if job.cached is not None:
        return _Prepared(job, job.cached.update(), job.cached, scan, snapshot)
    assert scan is not None
    unreached = 0
    try:
        update = pack(caster.cast(scan, frame.T_world_body))
    except DataError:  # not checked before casting: that would read every point of every scan once more
        scan, unreached = within_reach(scan, frame.T_world_body, config.octree)
        update = pack(caster.cast(scan, frame.T_world_body))
    cached = cache_update(frame.entry.stamp_ns, frame.T_world_body, update)
    return _Prepared(job, update, cached, scan, snapshot, unreached)


def _snapshot(frame: Frame, scan: Scan, config: McapConfig) -> Snapshot | ScanSnapshot:
    if not isinstance(frame, RgbdFrame):
        voxel_m = VOXEL_M["lidar-2d" if scan.is_planar else "lidar"]
        return ScanSnapshot(scan.stamp_ns, scan.points_body[thin(scan.points_body, voxel_m)])
    return Snapshot(
        frame.stamp_ns,
        encode_jpeg(frame.image, width_px=config.image_width_px),
        shrunk_camera(frame.camera, width_px=config.image_width_px),
        frame.T_body_camera,
    )
