"""Wheel odometry beside a log: poses in ``wheels.txt``, or readings in ``encoders.txt``."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError, SourceError
from mapper.core.frames import Sensor
from mapper.core.geometry import Transform, exp, inverse, transform
from mapper.core.trajectory import Trajectory
from mapper.sensing.wheel_kinematics import driven, without_jumps
from mapper.sources.config import WheelsConfig
from mapper.sources.text import parse_numbers, parse_stamp, pose_from_numbers, rows, table, time_order
from mapper.sources.trajectory_files import read_tum, write_tum

POSES, READINGS = "wheels.txt", "encoders.txt"
_POSE_COLUMNS, _PLANAR_COLUMNS = 8, 4

LOOKING_FORWARD: Mapping[Sensor, Transform] = {
    "rgbd": transform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3)),
    "lidar": np.eye(4),
    "lidar-2d": np.eye(4),
}
"""T_base_body of a body at the origin of a frame with x forward, y left and z up."""


def mounting(config: WheelsConfig, sensor: Sensor) -> Transform:
    """Return T_base_body as set, else at the origin and looking forward.

    Raises:
        SourceError: What was set is no pose.
    """
    if config.body_in_base is None:
        return LOOKING_FORWARD[sensor]
    T_base_body = pose_from_numbers(np.array(config.body_in_base))
    if T_base_body is None:
        raise SourceError(f"source.wheels.body_in_base={config.body_in_base}: its quaternion is zero")
    return T_base_body


def read_wheels(
    folder: Path, config: WheelsConfig, *, sensor: Sensor
) -> tuple[Trajectory | None, list[str], list[str]]:
    """Return T_odom_body of a log's wheels, if its folder has a file of them, a sentence on it, and notes.

    Args:
        folder: Folder that may hold ``wheels.txt`` (``stamp tx ty tz qx qy qz qw`` of the base, or ``stamp x
            y yaw_rad``) or ``encoders.txt`` (``stamp path_m steering_rad``).
        config: The wheelbase, and where the body is.
        sensor: Sensor whose frame is the body's.

    Raises:
        SourceError: A file is malformed, or there are readings but no wheelbase.
    """
    path = next((folder / name for name in (POSES, READINGS) if (folder / name).is_file()), None)
    if path is None:
        return None, [], []
    read, notes = read_wheels_file(path, config, sensor=sensor)
    wheels, more = usable(read)
    used = [] if wheels is None else [f"{path.name}: wheel odometry, {len(wheels)} poses"]
    return wheels, used, [*notes, *more]


def read_wheels_file(
    path: Path,
    config: WheelsConfig,
    *,
    sensor: Sensor,
    wheelbase_by: str = "--set source.wheels.wheelbase_m=…",
) -> tuple[Trajectory, list[str]]:
    """Return T_odom_body and notes as above of one file: poses if it is ``wheels.txt`` or has eight columns.

    Args:
        path: The file.
        config: Settings of the wheels.
        sensor: Sensor whose frame is the body's.
        wheelbase_by: Setting of the wheelbase, for the message.

    Raises:
        SourceError: As above.
    """
    columns = len(" ".join(next(rows(path), (0, []))[1]).replace(",", " ").split())
    notes: list[str] = []
    if path.name == POSES and columns == _PLANAR_COLUMNS:
        T_odom_base, notes = _planar(path)
    elif path.name == POSES or columns == _POSE_COLUMNS:
        try:
            T_odom_base = read_tum(path)
        except DataError as error:
            raise SourceError(str(error)) from None
    else:
        T_odom_base, notes = _integrated(path, config.wheelbase_m, wheelbase_by)
    wheels = replace(T_odom_base, T_world_body=T_odom_base.T_world_body @ mounting(config, sensor))
    return wheels, notes


def usable(wheels: Trajectory | None) -> tuple[Trajectory | None, list[str]]:
    """Return a log's wheel odometry without its jumps, None if it stands still all the time, and notes."""
    if wheels is None or not len(wheels):
        return wheels, []
    if not np.ptp(wheels.T_world_body, axis=0).any():
        return None, ["wheel odometry: it stands still all the time; not used"]
    return without_jumps(wheels)


def write_wheels(folder: Path, wheels: Trajectory, *, sensor: Sensor) -> None:
    """Write T_odom_body as the ``wheels.txt`` of a log, of a base that has its origin in the body's.

    It reads back without a configured mounting.
    """
    T_odom_base = wheels.T_world_body @ inverse(LOOKING_FORWARD[sensor])
    write_tum(folder / POSES, replace(wheels, T_world_body=T_odom_base))


def _planar(path: Path) -> tuple[Trajectory, list[str]]:
    """Return poses in the plane, in time order, and notes."""
    stamps_ns, numbers = [], []
    for where, words in table(path, "stamp", "x", "y", "yaw_rad"):
        stamps_ns.append(parse_stamp(words[0], where=where))
        numbers.append(parse_numbers(words[1:], where=where))
        if not np.isfinite(numbers[-1]).all():
            raise SourceError(f"{where}: want finite x, y and yaw")
    stamps = np.array(stamps_ns, dtype=np.int64)
    order, notes = time_order(stamps, what=path.name)
    poses = [exp(np.array([0.0, 0.0, yaw]), np.zeros(3)) for _, _, yaw in numbers]
    T = np.array(poses)[order]
    T[:, :2, 3] = np.array(numbers)[order, :2]
    return Trajectory(stamps[order], T), notes


def _integrated(path: Path, wheelbase_m: float | None, wheelbase_by: str) -> tuple[Trajectory, list[str]]:
    if wheelbase_m is None:
        raise SourceError(f"{path}: the wheelbase is unknown; {wheelbase_by}")
    stamps_ns, readings = [], []
    for where, words in table(path, "stamp", "path_m", "steering_rad"):
        reading = parse_numbers(words[1:], where=where)
        if not np.isfinite(reading).all() or abs(reading[1]) >= np.pi / 2.0:
            raise SourceError(f"{where}: want a finite path, and a steering angle within ±π/2 rad")
        stamps_ns.append(parse_stamp(words[0], where=where))
        readings.append(reading)
    if not readings:
        raise SourceError(f"{path}: no readings; want lines of stamp path_m steering_rad")
    stamps = np.array(stamps_ns, dtype=np.int64)
    order, notes = time_order(stamps, what=path.name)
    path_m, steering_rad = np.array(readings)[order].T
    return driven(stamps[order], path_m, steering_rad, wheelbase_m=wheelbase_m), notes
