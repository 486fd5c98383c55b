"""Frames of a log at their final poses, read as the maps take them."""

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from mapper.core.deskew import deskewed, twist_at
from mapper.core.frames import Frame, Scan, Sensor
from mapper.core.geometry import Transform
from mapper.core.timebase import NS_PER_S, nearest
from mapper.core.trajectory import Trajectory
from mapper.octree.config import OctreeConfig
from mapper.octree.ray_casting import reach_m
from mapper.sensing.gyroscope import Gyroscope
from mapper.sensing.sweep_motion import motion_during
from mapper.sources.base import FrameRef, Log

MOST_APART_NS = NS_PER_S // 2
"""Time from the next pose of the path beyond which nothing is said of where another sensor was."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedFrame:
    """A frame at its final pose.

    Attributes:
        entry: The frame.
        sensor: What took it.
        index: Index of its pose in the trajectory.
        T_world_body: (4, 4) its final pose, when its depth was measured.
        trajectory: Final poses of all frames of the same sensor.
        gyroscope: Readings of the log, for deskewing.
        wheels: T_odom_body of the log, for the same.
    """

    entry: FrameRef
    sensor: Sensor
    index: int
    T_world_body: Transform
    trajectory: Trajectory
    gyroscope: Gyroscope | None
    wheels: Trajectory | None

    def scan_of(self, frame: Frame) -> Scan:
        """Return the loaded frame as a scan, deskewed."""
        scan = frame.scan()
        motion = motion_during(scan, self.trajectory, self.index, self.gyroscope, self.wheels)
        return deskewed(scan, motion)


def placed_frames(source: Log, trajectory: Trajectory) -> Iterator[PlacedFrame]:
    """Yield the frames of a log that have a pose, in the log's order."""
    index_of = {int(stamp_ns): index for index, stamp_ns in enumerate(trajectory.stamps_ns)}
    for entry in source.entries_of(index_of):
        index = index_of[entry.stamp_ns]
        T_world_body = trajectory.T_world_body[index]
        if delay_ns := entry.depth_delay_ns:
            T_world_body = T_world_body @ twist_at(trajectory, index).over(delay_ns / NS_PER_S)
        yield PlacedFrame(
            entry, source.sensor, index, T_world_body, trajectory, source.gyroscope, source.wheels
        )


def sensor_paths(source: Log, trajectory: Trajectory) -> list[tuple[Log, Trajectory]]:
    """Return a log with its path, and the sensors beside it with theirs, where the path has poses nearby."""
    paths = [(source, trajectory)]
    for sensor in source.beside:
        stamps_ns = sensor.log.stamps_ns
        _, apart_ns = nearest(trajectory.stamps_ns, stamps_ns)
        is_near = (apart_ns <= MOST_APART_NS) & (stamps_ns >= trajectory.stamps_ns[0])
        path = trajectory.interpolate(stamps_ns[is_near & (stamps_ns <= trajectory.stamps_ns[-1])])
        paths.append((sensor.log, Trajectory(path.stamps_ns, path.T_world_body @ sensor.T_body_sensor)))
    return paths


def frames_in_order(paths: Iterable[tuple[Log, Trajectory]]) -> Iterator[PlacedFrame]:
    """Yield the frames that have a pose, of every sensor of ``sensor_paths``, in the order of time."""
    frames = [placed_frames(log, path) for log, path in paths]
    return heapq.merge(*frames, key=lambda frame: frame.entry.stamp_ns)


def within_reach(scan: Scan, T_world_body: Transform, config: OctreeConfig) -> tuple[Scan, int]:
    """Return a scan without the points that are too far from the map's origin to have keys, and their number.

    A single return that is damaged, and yet not beyond what a sensor reaches, must not end a build.
    """
    # Two voxels short of the reach: the octree rounds points to single precision and to voxels' centres.
    limit_m = reach_m(config.resolution_m) - 2.0 * config.resolution_m
    farthest_m = np.sqrt(3.0) * np.abs(scan.points_body).max(initial=0.0)
    if farthest_m + np.abs(T_world_body[:3, 3]).max() < limit_m:
        return scan, 0
    points_world = scan.points_body @ T_world_body[:3, :3].T + T_world_body[:3, 3]
    kept = np.abs(points_world).max(axis=1) < limit_m
    return scan.select(kept), len(kept) - int(kept.sum())
