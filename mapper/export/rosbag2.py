"""Results of a run as a ROS 2 bag, which ``ros2 bag play`` publishes and RViz shows."""

import heapq
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from mapper.core.frames import Cloud, Scan
from mapper.core.geometry import Transform, stride_for
from mapper.export.export_folders import export_folder
from mapper.export.mcap_messages import OCCUPANCY_GRID, encode_occupancy_grid
from mapper.export.run_maps import maps_of, snapshots_of
from mapper.export.run_mcap import BODY, CAMERA
from mapper.mapping.cloud import MOST_TO_VIEW
from mapper.mapping.fusion import Snapshot
from mapper.octree.grid import OccupancyGrid
from mapper.octree.octomap_file import bt_words
from mapper.run.folder import Run
from mapper.run.stored_tracking import base_in_body
from mapper.runtime.progress import Progress
from mapper.sources.ros.encode_ros import (
    SerializedMessage,
    camera_info_message,
    cloud_message,
    compressed_image_message,
    octomap_message,
    path_message,
    transforms_message,
)
from mapper.sources.ros.message_writers import rosbag2_writer

MAP = "map"
"""Name of the levelled world in ROS (REP 105)."""
_NAME = "results"


def rosbag2(run: Run, path: Path, _progress: Progress) -> None:
    """Write the folder; it replaces an earlier one.

    What holds for the whole log is latched at its first stamp; poses and images come at their own.

    Raises:
        RunError: PATH holds something else, or a file of the run is missing.
    """
    images = snapshots_of(run)
    first = next(images, None)
    with (
        export_folder(run, path, "rosbag2", files=("metadata.yaml", f"{_NAME}.mcap")) as folder,
        rosbag2_writer(folder, name=_NAME) as writer,
    ):
        for message in _latched_messages(run, first):
            writer.write(message._replace(is_latched=True))
        timed = map(_image_messages, chain([first] if first else [], images))
        for message in heapq.merge(
            _pose_messages(run), chain.from_iterable(timed), key=lambda message: message.stamp_ns
        ):
            writer.write(message)


def _latched_messages(run: Run, image: Snapshot | None) -> Iterator[SerializedMessage]:
    begin_ns, maps, robot = int(run.trajectory.stamps_ns[0]), maps_of(run), run.manifest.input.robot_of_all
    mounted: list[tuple[str, str, Transform]] = []
    if robot is not None and robot.mounting is not None and robot.base != robot.body:
        mounted.append((robot.base, robot.body, robot.mounting))
    if image is not None:
        mounted.append((BODY if robot is None else robot.body, CAMERA, image.T_body_camera))
    if mounted:
        yield transforms_message(begin_ns, "/tf_static", mounted)
    yield path_message(begin_ns, "/path", run.trajectory, frame=MAP)
    if (truth := run.results.truth) is not None:
        yield path_message(begin_ns, "/ground_truth", truth, frame=MAP)
    yield _grid_message(begin_ns, "/map", maps.grid)
    yield _grid_message(begin_ns, "/traversable", maps.traversable)
    if maps.keepout is not None:
        yield _grid_message(begin_ns, "/keepout", maps.keepout)
    yield _cloud_message(begin_ns, "/cloud", maps.cloud)
    yield _cloud_message(begin_ns, "/dynamic", maps.dynamic)
    words, _ = bt_words(maps.octree)
    yield octomap_message(
        begin_ns, "/octomap_binary", words, resolution_m=maps.octree.resolution_m, frame=MAP
    )


def _grid_message(stamp_ns: int, topic: str, grid: OccupancyGrid) -> SerializedMessage:
    data = encode_occupancy_grid(grid, stamp_ns=stamp_ns, frame_id=MAP)
    return SerializedMessage(stamp_ns, topic, OCCUPANCY_GRID, data)


def _cloud_message(stamp_ns: int, topic: str, cloud: Cloud) -> SerializedMessage:
    shown = slice(None, None, stride_for(len(cloud), MOST_TO_VIEW))
    intensities = None if cloud.intensities is None else cloud.intensities[shown]
    scan = Scan(stamp_ns, cloud.points[shown], colors=cloud.colors[shown], intensities=intensities)
    return cloud_message(topic, scan, frame=MAP)


def _pose_messages(run: Run) -> Iterator[SerializedMessage]:
    robot, T_body_base = run.manifest.input.robot_of_all, dict(base_in_body(run).items())
    poses, child = run.trajectory, BODY if robot is None else robot.body
    if robot is not None and robot.mounting is not None:
        poses, child = robot.trajectory_of_base(poses), robot.base
    for stamp_ns, T_world_child in poses.items():
        told = [(MAP, child, T_world_child)]
        if robot is not None and stamp_ns in T_body_base:
            told.append((robot.body, robot.base, T_body_base[stamp_ns]))
        yield transforms_message(stamp_ns, "/tf", told)


def _image_messages(image: Snapshot) -> Iterator[SerializedMessage]:
    yield camera_info_message(image.stamp_ns, "/camera/camera_info", image.camera, frame=CAMERA)
    yield compressed_image_message(
        image.stamp_ns, "/camera/image_raw/compressed", image.jpeg, format_="jpeg", frame=CAMERA
    )
