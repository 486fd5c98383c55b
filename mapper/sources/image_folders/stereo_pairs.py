"""Folders of EuRoC's stereo pairs (Burri et al. 2016), as of TUM-VI too; and logs of pairs of any layout.

``cam0`` and ``cam1`` with lists of images, ``imu0`` and the truth, maybe in ``mav0``; cameras are described
by ``sensor.yaml`` in each or by Kalibr's ``*camchain*.yaml``.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from mapper.core.errors import SourceError
from mapper.core.geometry import Transform, inverse
from mapper.core.trajectory import Trajectory
from mapper.sources.base import Accelerations, Log
from mapper.sources.camera_chain import UnitCamera, pair_beside, read_sensor_yaml
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.reading import read_view
from mapper.sources.image_folders.pairing import ImageList, pair_images
from mapper.sources.image_folders.rgbd import FramePair, first_size, rgbd_log
from mapper.sources.imu_files import read_euroc_imu
from mapper.sources.listed_files import within
from mapper.sources.stereo import StereoCamera, rectify, refuse_settings
from mapper.sources.text import parse_stamp, rows
from mapper.sources.trajectory_files import read_tum

_TRUTH = ("state_groundtruth_estimate0", "mocap0")


def recognise(path: Path) -> bool:
    """Return whether a path is a folder of the layout."""
    return _euroc(path) is not None


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a folder of stereo pairs; the body is the left camera, rectified.

    Raises:
        SourceError: No two images pair, a file is malformed, or the cameras are unknown or set by the user.
        DataError: A line of the truth is malformed.
    """
    refuse_settings(config.camera)
    folder = _euroc(path)
    if folder is None:
        raise SourceError(f"{path}: no cam0 and cam1 with data.csv each")
    return _euroc_log(path, folder, config)


def stereo_log(
    left: ImageList,
    right: ImageList,
    camera: StereoCamera,
    config: SourceConfig,
    *,
    path: Path,
    kind: str,
    truth: tuple[Trajectory | None, Iterable[str]],
    notes: Sequence[str],
) -> Log:
    """Return the log of left images that have a right one; arguments as of ``rgbd_log``."""
    pairs, pair_notes = pair_images(left, right, config, path=path, names=("left", "right"))
    camera.refuse_exchanged(
        lambda k: [partial(read_view, image) for image in (pairs[k].colour, pairs[k].depth)], len(pairs), path
    )
    return replace(
        rgbd_log(
            [_frame(pair, camera) for pair in pairs],
            camera.calibration,
            depth_units_per_m=camera.units_per_m,
            path=path,
            name=path.resolve().name,
            kind=kind,
            truth=truth,
            notes=[*notes, *pair_notes, camera.note],
        ),
        depth_noise=camera.noise,
    )


def _frame(pair: FramePair, camera: StereoCamera) -> FramePair:
    """Return the pair of an image and its depth that a pair of a left and a right image becomes."""
    left, right = partial(read_view, pair.colour), partial(read_view, pair.depth)
    return replace(
        pair,
        colour=pair.colour if camera.maps is None else camera.image_of(left, pair.colour),
        depth=camera.depth_of(left, right, pair.depth),
    )


def _euroc(path: Path) -> Path | None:
    """Return the folder of EuRoC's ``cam0`` and ``cam1``; None if there is none."""
    lists = [f"cam{k}/data.csv" for k in (0, 1)]
    folders = (path, path / "mav0")
    return next((folder for folder in folders if all((folder / name).is_file() for name in lists)), None)


def _euroc_log(path: Path, folder: Path, config: SourceConfig) -> Log:
    notes: list[str] = []
    left, right = (_listed(folder / name, notes) for name in ("cam0", "cam1"))
    size_px = first_size(left.paths, partial(read_view, in_colour=False), where=f"{folder / 'cam0'}")
    left_camera, right_camera = _euroc_cameras(path, folder)
    T_left_right = inverse(left_camera.T_unit_camera) @ right_camera.T_unit_camera
    camera = rectify(left_camera.calibration, right_camera.calibration, T_left_right, size_px)
    T_imu_body = left_camera.T_unit_camera @ camera.T_left_rectified
    truth, truth_notes = _euroc_truth(folder, T_imu_body)
    log = stereo_log(
        left, right, camera, config, path=path, kind="euroc", truth=(truth, truth_notes), notes=notes
    )
    readings = folder / "imu0" / "data.csv"
    if not readings.is_file():
        return log
    gyroscope, accelerations, imu_notes = read_euroc_imu(readings)
    T_body_imu = inverse(T_imu_body)
    R_body_imu = T_body_imu[:3, :3]
    if gyroscope is not None:
        gyroscope = replace(gyroscope, R_body_imu=R_body_imu)
    if accelerations is not None:
        turned_mps2 = accelerations.acceleration_mps2 @ R_body_imu.T
        accelerations = Accelerations(accelerations.stamps_ns, turned_mps2, True, T_body_imu[:3, 3])
    return replace(log, gyroscope=gyroscope, accelerations=accelerations, notes=[*log.notes, *imu_notes])


def _listed(folder: Path, notes: list[str]) -> ImageList:
    """Return the images of EuRoC's ``data.csv``: lines of nanoseconds and a name in ``data``."""
    path, stamps_ns, paths = folder / "data.csv", [], []
    for number, words in rows(path, separator=","):
        where = f"{path}:{number}"
        if len(words) != 2:
            raise SourceError(f"{where}: {len(words)} columns, want 2: stamp in nanoseconds, filename")
        stamps_ns.append(parse_stamp(f"{words[0]}e-9", where=where))
        paths.append(within(folder / "data", words[1], where=where))
    if not paths:
        raise SourceError(f"{path}: empty list; want lines of: stamp in nanoseconds, filename")
    images, order_notes = ImageList.in_time(stamps_ns, paths, what=f"{folder.name}/{path.name}")
    notes += order_notes
    return images


def _euroc_cameras(path: Path, folder: Path) -> tuple[UnitCamera, UnitCamera]:
    """Return both cameras and their poses in the body of the recording unit."""
    left, right = (folder / f"cam{k}" / "sensor.yaml" for k in (0, 1))
    if left.is_file() and right.is_file():
        return read_sensor_yaml(left), read_sensor_yaml(right)
    pair = pair_beside(path, folder, path / "dso")
    if pair is None:
        raise SourceError(f"{path}: no cam0/sensor.yaml and cam1/sensor.yaml, and no *camchain*.yaml")
    return pair


def _euroc_truth(folder: Path, T_imu_body: Transform) -> tuple[Trajectory | None, list[str]]:
    path = next((file for name in _TRUTH if (file := folder / name / "data.csv").is_file()), None)
    if path is None:
        return None, []
    truth = read_tum(path)
    return replace(truth, T_world_body=truth.T_world_body @ T_imu_body), []
