"""KITTI: velodyne/*.bin with calib.txt, poses.txt and times.txt (Geiger et al. 2012).

The benchmark keeps ``sequences/00/velodyne`` and ``poses/00.txt``; SemanticKITTI and converters of other
logs put ``poses.txt`` beside ``velodyne``. Where ``calib.txt`` has the pose of the LiDAR in the camera, poses
are the camera's; else they are the LiDAR's own. Raw recordings (Geiger et al. 2013) keep scans in
``velodyne_points/data`` and their times in ``velodyne_points/timestamps.txt``, without poses. The left colour
camera's images colour the cloud.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.frames import Image
from mapper.core.geometry import Array, Transform, inverse
from mapper.core.trajectory import Trajectory
from mapper.sources.base import CameraImages, Log, MountedSensor
from mapper.sources.calibration import Calibration
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.image_sizes import recorded_camera
from mapper.sources.image_files.reading import read_colour, read_grey
from mapper.sources.image_folders.rgbd import first_size
from mapper.sources.kitti_calibration import (
    matrix_of,
    offset_of,
    pose_beside,
    read_matrix,
    rectification,
    rigid_motion,
)
from mapper.sources.listed_files import only_one, refuse_links_out
from mapper.sources.scan_folders.scan_folder import clouds_in, first_of, most_clouds, scan_log
from mapper.sources.scan_stamps import stamps_list

_ALONG_Z_RATIO = 0.9
_CAMERAS_NOTE = (
    "the true poses move along their z, as a camera's do; without calib.txt they count as the LiDAR's"
)
_FOLDERS = ("image_2", "image_02/data")
_ENDINGS = {".png", ".jpg"}


def recognise(path: Path) -> bool:
    """Return whether a path is a sequence with one of the folders of scans in it, or holds such sequences."""
    return bool(_sequences(path))


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a sequence, or of the only one of a dataset's folder.

    Raises:
        SourceError: There are several sequences, no scan matches the pattern, or a text file is malformed.
        DataError: A line of poses is malformed.
    """
    sequence = only_one(path, _sequences(path), "sequences")
    folder = _scans(sequence)
    files, notes = clouds_in(folder, config.pattern)
    if not files:
        raise SourceError(f"{sequence}: no scan matches source.pattern={config.pattern}")
    at = sequence.resolve()
    mounting = read_matrix(calibration := sequence / "calib.txt", "Tr", 3, 4)
    T_camera_lidar = None if mounting is None else rigid_motion(mounting, f"{calibration}: Tr")
    log, scans = scan_log(
        sequence,
        files,
        kind="kitti",
        stamps_file=stamps_list([sequence, folder.parent]),
        truth_file=first_of(
            [sequence, at.parent.parent / "poses"], ["poses.txt", f"{at.name}.txt", "groundtruth.txt"]
        ),
        config=config,
        T_posed_lidar=T_camera_lidar,
        notes=notes,
    )
    if T_camera_lidar is None and log.truth is not None and _moves_as_a_camera(log.truth):
        log = replace(log, notes=[*log.notes, _CAMERAS_NOTE])
    return with_images(log, sequence, scans)


def _moves_as_a_camera(truth: Trajectory) -> bool:
    """Return whether poses move along z, a camera's forward; a LiDAR's z points up."""
    T = truth.T_world_body
    moved_world = np.diff(T[:, :3, 3], axis=0)
    along_z_m = np.abs((moved_world * T[:-1, :3, 2]).sum(axis=1)).sum()
    return bool(along_z_m > _ALONG_Z_RATIO * truth.path_length_m > 0.0)


def _sequences(path: Path) -> list[Path]:
    if most_clouds(_scans(path)):
        return [path]
    folders = [*path.glob("sequences/*"), *path.glob("*")]
    return sorted(folder for folder in folders if most_clouds(_scans(folder)))


def _scans(sequence: Path) -> Path:
    """Return the folder of a sequence's scans, which need not exist."""
    raw = sequence / "velodyne_points" / "data"
    return raw if most_clouds(raw) else sequence / "velodyne"


def with_images(log: Log, sequence: Path, scans: Sequence[Path]) -> Log:
    """Return the log with the images of the left colour camera that are named as scans.

    They are taken at the times of their scans: the LiDAR triggers the camera when it looks forward.

    Raises:
        SourceError: An image is a link out of the log.
    """
    folder = next((sequence / name for name in _FOLDERS if (sequence / name).is_dir()), None)
    if folder is None:
        return log
    by_stem = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in _ENDINGS}
    stamped = zip(log.stamps_ns.tolist(), scans, strict=True)
    paired = [(stamp_ns, by_stem[scan.stem]) for stamp_ns, scan in stamped if scan.stem in by_stem]
    if not paired:
        why = f"images that are not used, as none has the name of a scan: {folder}"
        return replace(log, notes=[*log.notes, why])
    stamps_ns, files = zip(*paired, strict=True)
    refuse_links_out(files, log=sequence)
    try:
        size_px = first_size(files, read_grey, where=f"{folder}")
        projection, T_camera_lidar = _camera(sequence, is_raw=folder.name == "data")
        fx, fy, cx, cy = (projection[k] for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
        recorded = recorded_camera(
            Calibration(f"{folder}", fx, fy, cx, cy), colour_px=size_px, depth_px=size_px, where=f"{folder}"
        )
    except SourceError as error:
        return replace(log, notes=[*log.notes, f"images that are not used: {error}"])

    def image_at(index: int) -> Image:
        return recorded.image(read_colour(files[index]), f"{files[index]}")

    name = folder.relative_to(sequence).as_posix()
    T_lidar_camera = inverse(T_camera_lidar)
    images = CameraImages(name, np.array(stamps_ns, np.int64), recorded.camera, T_lidar_camera, image_at)
    sensors = [MountedSensor(name, log.body_frame, T_lidar_camera)]
    return replace(log, images=[images], sensors=sensors, choices=[*log.choices, images.choice])


def _camera(sequence: Path, *, is_raw: bool) -> tuple[Array, Transform]:
    """Return the 3×4 projection of the colour camera, and T_camera_lidar.

    Raises:
        SourceError: They are not there, or malformed.
    """
    if is_raw:
        cameras = sequence.resolve().parent / "calib_cam_to_cam.txt"
        projection, mounted = (
            matrix_of(cameras, "P_rect_02", 3, 4),
            pose_beside(sequence, "calib_velo_to_cam.txt"),
        )
        if mounted is None:
            raise SourceError(f"{cameras.parent}: no calib_velo_to_cam.txt, the LiDAR's pose")
        T_first_lidar = rectification(cameras) @ mounted
    else:
        path = sequence / "calib.txt"
        projection, mounting = matrix_of(path, "P2", 3, 4), matrix_of(path, "Tr", 3, 4)
        T_first_lidar = rigid_motion(mounting, f"{path}: Tr")
    return projection, offset_of(projection) @ T_first_lidar
