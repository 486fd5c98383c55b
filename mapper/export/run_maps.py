"""A finished run's maps and pictures, read back from its files."""

from collections.abc import Iterator
from functools import partial
from itertools import count, takewhile
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError
from mapper.core.frames import PinholeCamera
from mapper.export.mcap_messages import MAP
from mapper.export.part_of_run import part_of_cloud
from mapper.export.transforms import CAMERA
from mapper.mapping.config import edits_of
from mapper.mapping.edits import MapEditor
from mapper.mapping.map_building import Maps, Snapshot
from mapper.navigation.reachable_floor import reachable_floor
from mapper.navigation.traversable_grid import TraversableFloor, traversable
from mapper.octree.grid import OccupancyGrid
from mapper.run import files
from mapper.run.cloud import read_cloud
from mapper.run.folder import Run
from mapper.run.map_folder import has_grid, stored_grid
from mapper.sources.ros.decode import decode
from mapper.sources.ros.mcap_file import open_mcap
from mapper.sources.ros.messages import CameraMessage, FileMessage
from mapper.sources.text import pose_from_numbers


def maps_of(run: Run) -> Maps:
    """Return what fusing made of a run.

    Raises:
        MapFileError: The octree cannot be read.
        FrameError: The cloud cannot be read.
        DataError: A grid cannot be read.
    """
    return Maps(
        octree=run.octree,
        cloud=run.cloud,
        dynamic=part_of_cloud(run, read_cloud(run.file(files.DYNAMIC))),
        grid=run.slice,
        traversable=run.traversable,
        storeys=tuple(_storeys(run)),
        keepout=run.keepout,
    )


def editor_of(run: Run) -> MapEditor:
    """Return the editor of a run's finished maps."""
    path_world, room_m = run.tracked_trajectory.positions_world, run.config.traversable.head_room_m
    return MapEditor(edits_of(run.manifest.edits), path_world, room_m)


def floor_of_run(run: Run) -> TraversableFloor:
    """Return a run's floor with its links, found again from its octree and its path.

    Raises:
        MapFileError: The octree cannot be read.
    """
    config, editor = run.config.traversable, editor_of(run)
    floor = reachable_floor(run.octree, config, positions_world=editor.path_world)
    return editor.edit_floor(traversable(floor, config, with_links=True))[0]


def _storeys(run: Run) -> Iterator[OccupancyGrid]:
    stems = takewhile(partial(has_grid, run), map(files.storey, count()))
    return map(partial(stored_grid, run), stems)


def snapshots_of(run: Run) -> Iterator[Snapshot]:
    """Yield the images of a run's MCAP log, in time order.

    Raises:
        DataError: The log cannot be read.
    """
    yield from read_snapshots(run.file(files.MCAP))


def read_snapshots(path: Path) -> Iterator[Snapshot]:
    """Yield the images of an MCAP log that :mod:`mapper.export.run_mcap` wrote, each with its own camera.

    Raises:
        DataError: The log cannot be read, or an image comes without a camera.
    """
    camera, T_body_camera = None, np.eye(4)
    for topic, _, _, data in open_mcap(path).messages():
        if topic.name not in ("/tf", "/camera/calibration", "/camera/image"):
            continue
        message = decode(topic, data)
        if isinstance(message, list):
            mounted = [told for told in message if told.child == CAMERA and told.parent != MAP]
            T_found = pose_from_numbers(np.array(mounted[0].numbers)) if mounted else None
            T_body_camera = T_body_camera if T_found is None else T_found
        elif isinstance(message, CameraMessage):
            camera = _camera(message)
        elif isinstance(message, FileMessage):
            if camera is None:
                raise DataError(f"{path}: image {message.stamp_ns} comes before any calibration")
            yield Snapshot(message.stamp_ns, bytes(message.data), camera, T_body_camera)


def _camera(message: CameraMessage) -> PinholeCamera:
    fx, _, cx, _, fy, cy, *_ = message.K.tolist()
    k1, k2, p1, p2, k3 = message.D.tolist()
    return PinholeCamera(message.width_px, message.height_px, fx, fy, cx, cy, (k1, k2, p1, p2, k3))
