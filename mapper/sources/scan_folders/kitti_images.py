"""Colour images beside KITTI's scans: ``image_2``, or ``image_02/data`` of a raw recording."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.frames import Image
from mapper.core.geometry import Array, Transform, inverse
from mapper.sources.base import CameraImages, Log, MountedSensor
from mapper.sources.calibration import Calibration
from mapper.sources.image_files.image_sizes import recorded_camera
from mapper.sources.image_files.reading import read_colour, read_grey
from mapper.sources.image_folders.rgbd import first_size
from mapper.sources.kitti_calibration import (
    lidar_in_first_camera,
    matrix_of,
    offset_of,
    rectification,
    rigid_motion,
)
from mapper.sources.listed_files import refuse_links_out
from mapper.sources.scan_folders.scans import ScanEntry

_FOLDERS = ("image_2", "image_02/data")
_ENDINGS = {".png", ".jpg"}


def with_images(log: Log, sequence: Path) -> Log:
    """Return the log with the images of the left colour camera that are named as scans.

    They are taken at the times of their scans: the LiDAR triggers the camera when it looks forward.

    Raises:
        SourceError: An image is a link out of the log.
    """
    folder = next((sequence / name for name in _FOLDERS if (sequence / name).is_dir()), None)
    if folder is None:
        return log
    by_stem = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in _ENDINGS}
    scans = (entry for entry in log.entries() if isinstance(entry, ScanEntry))
    paired = [(scan.stamp_ns, by_stem[scan.path.stem]) for scan in scans if scan.path.stem in by_stem]
    if not paired:
        why = f"images that are not used, as none has the name of a scan: {folder}"
        return replace(log, notes=[*log.notes, why])
    stamps_ns, files = zip(*paired, strict=True)
    refuse_links_out(files, log=sequence)
    try:
        size_px, reason = first_size(files, read_grey)
        if size_px is None:
            raise SourceError(f"none of {len(files)} images in {folder} can be read; the first: {reason}")
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
        projection, mounted = matrix_of(cameras, "P_rect_02", 3, 4), lidar_in_first_camera(sequence)
        if mounted is None:
            raise SourceError(f"{cameras.parent}: no calib_velo_to_cam.txt, the LiDAR's pose")
        T_first_lidar = rectification(cameras) @ mounted
    else:
        path = sequence / "calib.txt"
        projection, mounting = matrix_of(path, "P2", 3, 4), matrix_of(path, "Tr", 3, 4)
        T_first_lidar = rigid_motion(mounting, f"{path}: Tr")
    return projection, offset_of(projection) @ T_first_lidar
