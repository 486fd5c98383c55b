"""Readings beside a log's frames: wheels, inertial readings and GNSS fixes in files of its folder."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from mapper.core.timebase import Stamps, seconds_text_from_ns
from mapper.sources.base import Log, Readings
from mapper.sources.config import SourceConfig
from mapper.sources.gnss_files import read_gnss, write_gnss
from mapper.sources.imu_files import read_imu, write_gyroscope, write_imu
from mapper.sources.wheel_files import read_wheels, write_wheels

_UNITS_NS = {"µs": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
"""Units in which files have stamps that should be nanoseconds."""


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
        wheels, more = _in_log_time(wheels, log.stamps_ns, "wheel odometry")
        choices = log.choices if wheels is None else [*log.choices, *used]
        log = replace(log, wheels=wheels, choices=choices, notes=[*log.notes, *notes, *more])
    if log.gyroscope is None:
        gyroscope, accelerations, notes = read_imu(folder)
        gyroscope, more = _in_log_time(gyroscope, log.stamps_ns, "angular velocities")
        log = replace(log, gyroscope=gyroscope, notes=[*log.notes, *notes, *more])
        if log.accelerations is None:
            accelerations, more = _in_log_time(accelerations, log.stamps_ns, "accelerations")
            log = replace(log, accelerations=accelerations, notes=[*log.notes, *more])
    if log.gnss is None:
        gnss, notes = read_gnss(log.path)
        gnss, more = _in_log_time(gnss, log.stamps_ns, "GNSS fixes")
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


def _in_log_time(
    readings: Readings | None, frames_ns: Stamps, name: str
) -> tuple[Readings | None, list[str]]:
    """Return readings with stamps of the frames' time, and a note on stamps in another unit, or of no use."""
    if readings is None or not len(readings.stamps_ns) or _overlap(readings.stamps_ns, frames_ns):
        return readings, []
    for unit, unit_ns in _UNITS_NS.items():
        if readings.stamps_ns[-1] <= np.iinfo(np.int64).max // unit_ns:
            stamps_ns = readings.stamps_ns * unit_ns
            if _overlap(stamps_ns, frames_ns):
                note = f"{name}: stamps are taken in {unit}, as in ns none is of the frames' time"
                return replace(readings, stamps_ns=stamps_ns), [note]
    first_s, frames_s = (
        seconds_text_from_ns(int(stamps_ns[0])) for stamps_ns in (readings.stamps_ns, frames_ns)
    )
    return None, [
        f"{name}: they begin at {first_s} s and frames at {frames_s} s, so none is of their time; not used"
    ]


def _overlap(readings_ns: Stamps, frames_ns: Stamps) -> bool:
    return bool(readings_ns[0] <= frames_ns[-1] and frames_ns[0] <= readings_ns[-1])
