"""Cameras of a recording unit: Kalibr's ``camchain.yaml`` (Furgale et al. 2013), EuRoC's ``sensor.yaml``."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import Transform, inverse
from mapper.runtime.regular_files import read_text
from mapper.sources.calibration import Calibration
from mapper.sources.calibration_file import read_yaml
from mapper.sources.text import pose_from_matrix

_SECTION = re.compile(r"^cam(\d):[ \t]*\n((?:[ \t]+.*\n?|\s*\n)+)", re.MULTILINE)
_TOPIC = re.compile(r"^\s+rostopic:\s*[\"']?([^\s\"']+)", re.MULTILINE)
_NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")


@dataclass(frozen=True, slots=True, eq=False)
class UnitCamera:
    """Camera of a recording unit.

    Attributes:
        calibration: The camera.
        T_unit_camera: (4, 4) pose in the unit: its IMU, or its first camera where no IMU is described.
    """

    calibration: Calibration
    T_unit_camera: Transform


def read_sensor_yaml(path: Path) -> UnitCamera:
    """Return the camera that EuRoC's file describes.

    Raises:
        SourceError: The file cannot be read, lacks a number or the pose, or the lens is unknown.
    """
    text = read_text(path, error=SourceError)
    T_unit_camera = _pose(text, "T_BS", f"{path}")
    if T_unit_camera is None:
        raise SourceError(f"{path}: want the camera's pose, T_BS")
    return UnitCamera(read_yaml(text, f"{path}"), T_unit_camera)


def pair_beside(*folders: Path, topics: tuple[str, str] = ("", "")) -> tuple[UnitCamera, UnitCamera] | None:
    """Return two cameras of the first ``*camchain*.yaml`` in some folders; None if there is no such file.

    Args:
        folders: Where it is looked for.
        topics: Topics of their images; unless it has both, the cameras are cam0 and cam1.

    Raises:
        SourceError: It cannot be read, or does not describe the two and their poses.
    """
    files = [path for folder in folders for path in sorted(folder.glob("*camchain*.yaml")) if path.is_file()]
    if not files:
        return None
    text = read_text(files[0], error=SourceError).replace("\r\n", "\n")
    sections = dict(_SECTION.findall(text))
    if not {"0", "1"} <= sections.keys():
        raise SourceError(f"{files[0]}: want cameras cam0 and cam1")
    found = {topic[1]: number for number, one in sections.items() if (topic := _TOPIC.search(one))}
    left, right = ("0", "1") if not found.keys() >= {*topics} else (found[topic] for topic in topics)
    poses: dict[str, Transform] = {}
    T_unit_before = np.eye(4)
    for number in sorted(one for one in sections if one <= max(left, right)):
        where = f"{files[0]}: cam{number}"
        if (T_camera_imu := _pose(sections[number], "T_cam_imu", where)) is not None:
            T_unit_before = inverse(T_camera_imu)
        elif poses:
            if (T_camera_before := _pose(sections[number], "T_cn_cnm1", where)) is None:
                raise SourceError(f"{where}: want the camera's pose, T_cam_imu or T_cn_cnm1")
            T_unit_before = T_unit_before @ inverse(T_camera_before)
        poses[number] = T_unit_before
    one, other = (
        UnitCamera(read_yaml(sections[number], f"{files[0]}: cam{number}"), poses[number])
        for number in (left, right)
    )
    return one, other


def _pose(text: str, key: str, where: str) -> Transform | None:
    """Return the pose of a key, None without the key.

    Raises:
        SourceError: It is no rigid motion.
    """
    _, found, rest = text.partition(f"{key}:")
    if not found:
        return None
    numbers = _NUMBER.findall(re.sub(r"(?:cols|rows):\s*\d+", "", rest))
    T = pose_from_matrix(np.array(numbers[:16], np.float64).reshape(4, 4)) if len(numbers) >= 16 else None
    if T is None:
        raise SourceError(f"{where}: {key} is no rigid motion of 16 numbers")
    return T
