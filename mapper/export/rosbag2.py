"""Results of a run as a ROS 2 bag, which ``ros2 bag play`` publishes and RViz shows."""

import heapq
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from mapper.core.frames import Cloud, Scan
from mapper.core.geometry import stride_for
from mapper.export.export_folders import export_folder
from mapper.export.mcap_messages import MAP, OCCUPANCY_GRID, encode_occupancy_grid
from mapper.export.run_maps import maps_of, snapshots_of
from mapper.export.transforms import Transforms, transforms_of
from mapper.mapping.cloud import MOST_TO_VIEW
from mapper.mapping.map_building import Snapshot
from mapper.octree.grid import OccupancyGrid
from mapper.octree.octomap_file import bt_words
from mapper.run.folder import Run
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
from mapper.sources.ros.message_writers import write_rosbag2

_NAME = "results"


def rosbag2(run: Run, path: Path, _progress: Progress) -> None:
    """Write the folder; it replaces an earlier one.

    What holds for the whole log is latched at its first stamp; poses and images come at their own.

    Raises:
        RunError: PATH holds something else, or a file of the run is missing.
    """
    images, transforms = snapshots_of(run), transforms_of(run)
    first = next(images, None)
    latched = (one._replace(is_latched=True) for one in _latched_messages(run, transforms, first))
    timed = (
        _image_messages(image, transforms.camera_of(image))
        for image in chain([first] if first else [], images)
    )
    poses = (transforms_message(stamp_ns, "/tf", links) for stamp_ns, links in transforms.moving)
    moving = heapq.merge(poses, chain.from_iterable(timed), key=lambda message: message.stamp_ns)
    with export_folder(run, path, "rosbag2", files=("metadata.yaml", f"{_NAME}.mcap")) as folder:
        write_rosbag2(folder, chain(latched, moving), name=_NAME)


def _latched_messages(
    run: Run, transforms: Transforms, image: Snapshot | None
) -> Iterator[SerializedMessage]:
    begin_ns, maps, static = int(run.trajectory.stamps_ns[0]), maps_of(run), [*transforms.static]
    if image is not None and (camera := transforms.camera_of(image)) != transforms.body:
        static.append((transforms.body, camera, image.T_body_camera))
    if static:
        yield transforms_message(begin_ns, "/tf_static", static)
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


def _image_messages(image: Snapshot, frame: str) -> Iterator[SerializedMessage]:
    yield camera_info_message(image.stamp_ns, "/camera/camera_info", image.camera, frame=frame)
    yield compressed_image_message(
        image.stamp_ns, "/camera/image_raw/compressed", image.jpeg, format_="jpeg", frame=frame
    )
