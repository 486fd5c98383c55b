"""KITTI: velodyne/*.bin with calib.txt, poses.txt and times.txt (Geiger et al. 2012).

The benchmark keeps ``sequences/00/velodyne`` and ``poses/00.txt``; SemanticKITTI and converters of other
logs put ``poses.txt`` beside ``velodyne``. Where ``calib.txt`` has the pose of the LiDAR in the camera, poses
are the camera's; else they are the LiDAR's own. Raw recordings (Geiger et al. 2013) keep scans in
``velodyne_points/data`` and their times in ``velodyne_points/timestamps.txt``, without poses. The left colour
camera's images colour the cloud.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.trajectory import Trajectory
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.kitti_calibration import read_matrix, rigid_motion
from mapper.sources.scan_folders.kitti_images import with_images
from mapper.sources.scan_folders.scan_folder import clouds_in, first_of, most_clouds, scan_log
from mapper.sources.scan_stamps import stamps_list

_ALONG_Z_RATIO = 0.9
_CAMERAS_NOTE = (
    "the true poses move along their z, as a camera's do; without calib.txt they count as the LiDAR's"
)


def recognise(path: Path) -> bool:
    """Return whether a path is a sequence with one of the folders of scans in it, or holds such sequences."""
    return bool(_sequences(path))


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a sequence, or of the only one of a dataset's folder.

    Raises:
        SourceError: There are several sequences, no scan matches the pattern, or a text file is malformed.
        DataError: A line of poses is malformed.
    """
    sequences = _sequences(path)
    if len(sequences) != 1:
        names = ", ".join(str(folder.relative_to(path)) for folder in sequences)
        raise SourceError(f"{path}: holds {len(sequences)} sequences; open one of {names}")
    sequence = sequences[0]
    scans = _scans(sequence)
    files, notes = clouds_in(scans, config.pattern)
    if not files:
        raise SourceError(f"{sequence}: no scan matches source.pattern={config.pattern}")
    at = sequence.resolve()
    mounting = read_matrix(calibration := sequence / "calib.txt", "Tr", 3, 4)
    T_camera_lidar = None if mounting is None else rigid_motion(mounting, f"{calibration}: Tr")
    log = scan_log(
        sequence,
        files,
        kind="kitti",
        stamps_file=stamps_list([sequence, scans.parent]),
        truth_file=first_of(
            [sequence, at.parent.parent / "poses"], ["poses.txt", f"{at.name}.txt", "groundtruth.txt"]
        ),
        config=config,
        T_posed_lidar=T_camera_lidar,
        notes=notes,
    )
    if T_camera_lidar is None and log.truth is not None and _moves_as_a_camera(log.truth):
        log = replace(log, notes=[*log.notes, _CAMERAS_NOTE])
    return with_images(log, sequence)


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
