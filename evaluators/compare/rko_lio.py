"""RKO-LIO (Malladi, Hermann, Stachniss & Behley 2025), the library itself, on scans and inertial readings."""

import atexit
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from mapper.core.errors import ConfigError
from mapper.core.frames import Scan
from mapper.core.geometry import Array, interpolate, transform
from mapper.core.rotations import rotation_from_quaternion
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.runtime.extras import extra
from mapper.sources.base import Log


class RkoLioTracker:
    """Tracker by the library with its defaults, on one thread: no loops, no settings of a log.

    It gets the readings as the log states them, the unit at the body's origin, and turned to the body's axes
    if the log has the mounting: it estimates no calibration. Its poses are those at the ends of the sweeps.
    """

    def __init__(self, log: Log) -> None:
        """Begin before the first scan.

        Raises:
            ConfigError: The log lacks angular velocities or accelerations.
            DependencyError: The library is not installed.
        """
        with extra("peers", "--method rko-lio"):
            from rko_lio.config import LIOConfig
            from rko_lio.lio import LIO
            from rko_lio.rko_lio_pybind import RegistrationError
        if log.gyroscope is None or log.accelerations is None:
            raise ConfigError(f"{log.path}: no angular velocities or no accelerations, which rko-lio needs")
        self._stamps_ns, self._rates = log.gyroscope.stamps_ns, log.gyroscope.rates_radps
        readings = log.accelerations.acceleration_mps2
        at = (self._stamps_ns, log.accelerations.stamps_ns)
        self._accelerations: Array = np.stack([np.interp(*at, column) for column in readings.T], axis=1)
        self._T_body_imu = transform(
            np.eye(3) if log.gyroscope.R_body_imu is None else log.gyroscope.R_body_imu, np.zeros(3)
        )
        self._lost, self._used = RegistrationError, 0
        self._frames_ns: list[int] = []
        with _silence():
            self._lio = LIO(LIOConfig(max_num_threads=1))

    def add(self, scan: Scan) -> bool:
        """Add the readings until the end of a scan, then the scan; it is lost if nothing corresponds."""
        times_s = np.zeros(len(scan.points_body)) if scan.times_s is None else scan.times_s.astype(np.float64)
        times_ns = scan.stamp_ns + np.round(times_s * NS_PER_S).astype(np.int64)
        until = int(np.searchsorted(self._stamps_ns, times_ns.max(), side="right"))
        with _silence():
            for i in range(self._used, until):
                self._lio.add_imu_measurement(
                    self._accelerations[i], self._rates[i], int(self._stamps_ns[i]), self._T_body_imu
                )
            self._used = until
            try:
                self._lio.register_scan(scan.points_body, times_ns, np.eye(4))
            except self._lost:
                return False
        self._frames_ns.append(scan.stamp_ns)
        return True

    def trajectory(self) -> Trajectory:
        """Return the poses at the scans' stamps, by constant velocity between the ends of the sweeps."""
        ends_ns, rows = self._lio.poses_with_timestamps()  # x y z and quaternion, x first
        poses = [transform(rotation_from_quaternion(row[3:]), row[:3]) for row in np.array(rows)]
        if len(poses) < 2:
            return trajectory_from(())
        last = np.clip(np.searchsorted(ends_ns, self._frames_ns), 1, len(poses) - 1)
        return trajectory_from(
            (
                stamp_ns,
                interpolate(
                    poses[i - 1], poses[i], (stamp_ns - ends_ns[i - 1]) / (ends_ns[i] - ends_ns[i - 1])
                ),
            )
            for stamp_ns, i in zip(self._frames_ns, last, strict=True)
        )


@contextmanager
def _silence() -> Iterator[None]:
    """Drop what the library prints on standard output, now and, its timings, when the program ends."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        _close_output()
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        atexit.unregister(_close_output)
        atexit.register(_close_output)


def _close_output() -> None:
    sys.stdout.flush()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)
