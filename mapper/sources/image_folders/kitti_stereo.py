"""Folders of KITTI's stereo pairs: sequences (Geiger et al. 2012) and raw drives (Geiger et al. 2013).

Colour is in ``image_2`` and ``image_3``, grey in ``image_0`` and ``image_1``, with ``calib.txt``,
``times.txt`` and ``poses.txt``, or as in the benchmark's folder: ``sequences/00`` and ``poses/00.txt``. Raw
drives keep ``image_02/data`` with ``image_02/timestamps.txt`` and so on; the cameras of a day's drives are in
``calib_cam_to_cam.txt`` beside them. Pairs are rectified, except in drives that are called ``_extract``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import Array, Transform, apply, inverse
from mapper.core.timebase import Stamps
from mapper.core.trajectory import Trajectory
from mapper.sensing.gnss import GnssFixes
from mapper.sources.base import Log
from mapper.sources.calibration import Calibration
from mapper.sources.config import SourceConfig
from mapper.sources.gnss_files import OXTS, read_gnss
from mapper.sources.image_files.image_sizes import Size
from mapper.sources.image_files.reading import read_grey
from mapper.sources.image_folders.pairing import ImageList
from mapper.sources.image_folders.rgbd import first_size
from mapper.sources.image_folders.stereo_pairs import stereo_log
from mapper.sources.kitti_calibration import (
    matrix_of,
    offset_of,
    pose_beside,
    read_matrix,
    rectification,
    rigid_motion,
)
from mapper.sources.listed_files import only_one
from mapper.sources.scan_stamps import Wording, in_order, scan_stamps
from mapper.sources.stereo import StereoCamera, rectified_pair, rectify, refuse_settings
from mapper.sources.text import truth_from
from mapper.sources.trajectory_files import read_kitti

_COLOUR, _GREY = ("2", "3"), ("0", "1")
_ENDINGS = {".png", ".jpg"}


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Left and right images of a sequence, in order, and where their cameras are described."""

    sequence: Path
    numbers: tuple[str, str]
    left: Sequence[Path]
    right: Sequence[Path]
    is_raw: bool

    @property
    def calibration(self) -> Path:
        if not self.is_raw:
            return self.sequence / "calib.txt"
        return self.sequence.resolve().parent / "calib_cam_to_cam.txt"

    def stamps_list(self, files: Sequence[Path]) -> Path:
        return files[0].parents[1] / "timestamps.txt" if self.is_raw else self.sequence / "times.txt"


def recognise(path: Path) -> bool:
    """Return whether a path is a sequence or a drive of pairs, or holds such folders."""
    return bool(_sequences(path))


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a sequence or a drive, or of the only one in a folder; the body is the left camera.

    Raises:
        SourceError: There are several, no two images pair, a file is malformed, or the cameras are unknown
            or set by the user.
        DataError: A line of the truth is malformed.
    """
    refuse_settings(config.camera)
    sequences = _sequences(path)
    only_one(path, [one.sequence for one in sequences], "sequences")
    pairs = sequences[0]
    left_ns, notes = _stamps(pairs, pairs.left, config)
    right_ns = left_ns
    if [file.stem for file in pairs.left] != [file.stem for file in pairs.right]:
        if not pairs.is_raw:
            raise SourceError(
                f"{pairs.left[0].parent}, {pairs.right[0].parent}: not the same names; {len(pairs.left)} and "
                f"{len(pairs.right)} images"
            )
        right_ns, more = _stamps(pairs, pairs.right, config)
        notes = list(dict.fromkeys([*notes, *more]))
    size_px = first_size(pairs.left, read_grey, where=f"{pairs.left[0].parent}")
    camera, T_body_first = _raw_camera(pairs, size_px) if pairs.is_raw else _camera(pairs, size_px)
    left, order_notes = ImageList.in_time(left_ns, pairs.left, what="pairs")
    right, _ = ImageList.in_time(right_ns, pairs.right, what="pairs")
    log = stereo_log(
        left,
        right,
        camera,
        config,
        path=pairs.sequence,
        kind="kitti-stereo",
        truth=_truth(pairs, left_ns, T_body_first),
        notes=[*notes, *order_notes],
    )
    gnss, gnss_notes = _gnss(pairs.sequence, T_body_first) if pairs.is_raw else (None, [])
    return replace(log, gnss=gnss, notes=[*log.notes, *gnss_notes])


def _sequences(path: Path) -> list[_Pairs]:
    if found := _pairs_in(path):
        return [found]
    folders = sorted([*path.glob("sequences/*"), *path.glob("*")])
    return [found for folder in folders if folder.is_dir() and (found := _pairs_in(folder))]


def _pairs_in(folder: Path) -> _Pairs | None:
    layouts = [("image_0{}/data", True)]
    if (folder / "calib.txt").is_file():
        layouts.append(("image_{}", False))
    for name, is_raw in layouts:
        for numbers in (_COLOUR, _GREY):
            left, right = (_images(folder / name.format(number)) for number in numbers)
            if left and right:
                return _Pairs(folder, numbers, left, right, is_raw)
    return None


def _images(folder: Path) -> list[Path]:
    return in_order(path for path in folder.glob("[!.]*") if path.suffix.lower() in _ENDINGS)


def _stamps(pairs: _Pairs, files: Sequence[Path], config: SourceConfig) -> tuple[Stamps, list[str]]:
    beside = pairs.stamps_list(files)
    return scan_stamps(
        files,
        chosen=None,
        beside=beside if beside.is_file() else None,
        rate_hz=config.rate_hz,
        wording=Wording("pairs", stamps_file=beside.name),
    )


def _camera(pairs: _Pairs, size_px: Size) -> tuple[StereoCamera, Transform]:
    """Return the camera of a sequence, and T_body_first of the first camera, whose poses are stated."""
    P_left, P_right = (matrix_of(pairs.calibration, f"P{number}", 3, 4) for number in pairs.numbers)
    return _rectified(pairs, P_left, P_right, size_px), offset_of(P_left)


def _raw_camera(pairs: _Pairs, size_px: Size) -> tuple[StereoCamera, Transform]:
    """Return the camera of a drive, and T_body_first of the first camera before it is rectified."""
    path, names = pairs.calibration, [f"0{number}" for number in pairs.numbers]
    stated = read_matrix(path, f"S_rect_{names[0]}", 2)
    if stated is None or tuple(stated.tolist()) == size_px:
        P_left, P_right = (matrix_of(path, f"P_rect_{name}", 3, 4) for name in names)
        return _rectified(pairs, P_left, P_right, size_px), offset_of(P_left) @ rectification(path)
    (left, T_left_first), (right, T_right_first) = (_as_recorded(path, name) for name in names)
    camera = rectify(left, right, T_left_first @ inverse(T_right_first), size_px)
    return camera, inverse(camera.T_left_rectified) @ T_left_first


def _rectified(pairs: _Pairs, P_left: Array, P_right: Array, size_px: Size) -> StereoCamera:
    fx, fy, cx, cy = (P_left[k] for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not fx > 0.0:
        raise SourceError(f"{pairs.calibration}: focal length {fx:g} px, want > 0")
    calibration = Calibration(f"{pairs.calibration}", fx, fy, cx, cy, size_px=size_px)
    return rectified_pair(calibration, (P_left[0, 3] - P_right[0, 3]) / fx, size_px)


def _as_recorded(path: Path, name: str) -> tuple[Calibration, Transform]:
    """Return a camera as it was before rectification, and T_camera_first."""
    width, height = matrix_of(path, f"S_{name}", 2).tolist()
    K, (k1, k2, p1, p2, k3) = matrix_of(path, f"K_{name}", 3, 3), matrix_of(path, f"D_{name}", 5).tolist()
    calibration = Calibration(
        f"{path}: K_{name}",
        *(K[0, 0], K[1, 1], K[0, 2], K[1, 2]),
        distortion=(k1, k2, p1, p2, k3),
        size_px=(round(width), round(height)),
    )
    pose = np.column_stack([matrix_of(path, f"R_{name}", 3, 3), matrix_of(path, f"T_{name}", 3)])
    return calibration, rigid_motion(pose, f"{path}: R_{name}, T_{name}")


def _truth(pairs: _Pairs, stamps_ns: Stamps, T_body_first: Transform) -> tuple[Trajectory | None, list[str]]:
    """Return the true poses of a sequence; those of the benchmark are in a folder of their own."""
    at = pairs.sequence.resolve()
    files = pairs.sequence / "poses.txt", at.parent.parent / "poses" / f"{at.name}.txt"
    path = next((file for file in files if file.is_file()), None)
    if path is None or pairs.is_raw:
        return None, []
    poses = read_kitti(path).T_world_body
    if len(poses) != len(stamps_ns):
        raise SourceError(f"{path}: {len(poses)} poses for {len(stamps_ns)} pairs of images")
    posed = zip(stamps_ns.tolist(), poses @ inverse(T_body_first), strict=True)
    return truth_from(list(posed), what=path.name)


def _gnss(drive: Path, T_body_first: Transform) -> tuple[GnssFixes | None, list[str]]:
    """Return the fixes of a drive, the place of ``oxts`` turned from the LiDAR's frame into the body's."""
    fixes, notes = read_gnss(drive)
    if fixes is None or fixes.name != OXTS or fixes.antenna_body is None:
        return fixes, notes if fixes else []
    T_first_lidar = pose_beside(drive, "calib_velo_to_cam.txt")
    antenna = (
        None if T_first_lidar is None else apply(T_body_first @ T_first_lidar, fixes.antenna_body[None])[0]
    )
    return replace(fixes, antenna_body=antenna), notes
