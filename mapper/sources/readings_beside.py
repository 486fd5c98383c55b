"""Readings beside a log's frames: wheels, inertial readings and GNSS fixes in files of its folder."""

from dataclasses import replace
from pathlib import Path

from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.gnss_files import read_gnss, write_gnss
from mapper.sources.imu_files import read_imu, write_gyroscope, write_imu
from mapper.sources.time_offsets import in_log_time
from mapper.sources.wheel_files import read_wheels, write_wheels


def with_readings(log: Log, folder: Path, config: SourceConfig) -> Log:
    """Return a log with the readings of files in its folder, of each kind that the log itself has not.

    Args:
        log: The log.
        folder: Folder that was opened.
        config: Settings of the wheels.

    Raises:
        SourceError: A file is malformed.
    """
    if log.wheels is None:
        wheels, used, notes = read_wheels(folder, config.wheels, sensor=log.sensor)
        wheels, more = in_log_time(wheels, log.stamps_ns, "wheels", offset_s=config.wheels_offset_s)
        choices = log.choices if wheels is None else [*log.choices, *used]
        log = replace(log, wheels=wheels, choices=choices, notes=[*log.notes, *notes, *more])
    if log.gyroscope is None:
        gyroscope, accelerations, notes = read_imu(folder)
        gyroscope, more = in_log_time(gyroscope, log.stamps_ns, "gyroscope", offset_s=config.imu_offset_s)
        log = replace(log, gyroscope=gyroscope, notes=[*log.notes, *notes, *more])
        if log.accelerations is None:
            accelerations, more = in_log_time(
                accelerations, log.stamps_ns, "accelerations", offset_s=config.imu_offset_s
            )
            log = replace(log, accelerations=accelerations, notes=[*log.notes, *more])
    if log.gnss is None:
        gnss, notes = read_gnss(log.path)
        gnss, more = in_log_time(gnss, log.stamps_ns, "GNSS fixes")
        log = replace(log, gnss=gnss, notes=[*log.notes, *notes, *more])
    return log


def write_readings(log: Log, folder: Path, *, are_imu: bool = False) -> None:
    """Write the wheels, angular velocities and GNSS fixes of a log as files that ``with_readings`` reads.

    Args:
        log: The log.
        folder: Folder of the written log.
        are_imu: Whether accelerations have the stamps of the angular velocities, and are in their file.
    """
    if log.wheels is not None:
        write_wheels(folder, log.wheels, sensor=log.sensor)
    if are_imu and log.gyroscope is not None and log.accelerations is not None:
        write_imu(folder, log.gyroscope, log.accelerations)
    elif log.gyroscope is not None:
        write_gyroscope(folder, log.gyroscope)
    if log.gnss is not None:
        write_gnss(folder, log.gnss)
